"""Training throughput: windows and transitions a second through the real training step.

Usage: python benchmarks/training_throughput.py [--quick] [--json FILE]
"""

import time
from dataclasses import replace

import jax
from measuring import arguments, report

from contactgraph.data import Dataset, split_by_trajectory
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import collect
from contactgraph.model import ModelConfig, ours
from contactgraph.train import FitProgress, FitState, TrainConfig, fit, initial_state


def measured(config: TrainConfig, dataset: Dataset, chunks: int) -> dict[str, float | str | int]:
    """One row. Each check of `fit` ends a chunk of steps; the first chunks compile."""
    train, held_out = split_by_trajectory(dataset, 0.15, seed=0)
    model = ours(ModelConfig(2, 2, dataset.dt), key=jax.random.key(0))
    warm = replace(config, steps=2 * config.check_every)
    began = time.perf_counter()
    state = fit(initial_state(model, warm, seed=0), train, held_out, warm).state
    first = time.perf_counter() - began

    times: list[float] = []

    def on_check(check: FitProgress) -> None:
        times.append(time.perf_counter())

    # Another number of steps is another schedule of the learning rate, and compiles again; so
    # the same recipe is run from its start, over and over, in the program that is there.
    start = _at_start(state)
    for _ in range(chunks):
        fit(start, train, held_out, warm, on_check)
    # Between the two checks of one call lies exactly one chunk.
    chunk = min(after - before for before, after in zip(times[::2], times[1::2], strict=True))
    steps = config.check_every / chunk
    windows = steps * config.batch_size
    return {
        "rollout term": "yes" if config.rollout_from == 0.0 else "no",
        "nodes": 2 + config.bystanders,
        "batch": config.batch_size,
        "compile s": first - 2 * chunk,
        "ms/step": 1e3 / steps,
        "windows/s": windows,
        "transitions/s": windows * config.window_length,
    }


def _at_start(state: FitState) -> FitState:
    zero = jax.tree.map(lambda leaf: leaf * 0, (state.step, state.checks_without_gain))
    return FitState(
        model=state.model,
        optimiser=state.optimiser,
        key=state.key,
        step=zero[0],
        best_model=state.best_model,
        best_error=state.best_error,
        checks_without_gain=zero[1],
    )


def main() -> None:
    """Measure and print."""
    options = arguments("Throughput of training.")
    dataset = Dataset(tuple(collect([PickupTask], [PickupExpert()], 40, seed=0)))
    base = TrainConfig(check_every=10 if options.quick else 100)
    batches = (32,) if options.quick else (32, 128)
    rows = [
        measured(
            replace(base, batch_size=batch, rollout_from=share), dataset, 2 if options.quick else 4
        )
        for batch in batches
        for share in (1.0, 0.0)
    ]
    report("training_throughput", rows, options)


if __name__ == "__main__":
    main()
