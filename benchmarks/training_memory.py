"""Memory of a training step in large scenes, as XLA plans it for the compiled step.

Usage: python benchmarks/training_memory.py [--quick] [--json FILE]

Loss and gradient on one window of 50 steps are compiled for shapes alone and not run; XLA reports
the planned memory.
"""

import time
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from measuring import arguments, report
from model_at_scale import crowd, listing

from contactgraph.data import TrajectoryBatch
from contactgraph.model import ContactDynamics, load_model, shipped_model
from contactgraph.train import LossTerms
from contactgraph.train.window_loss import rollout_loss, window_loss

_STEPS = 50


def measured(
    model: ContactDynamics, count: int, with_rollout: bool
) -> dict[str, float | int | str]:
    """One row."""
    position, _, nodes = crowd(count)
    states = jax.ShapeDtypeStruct((1, _STEPS + 1, *position.shape), jnp.float32)
    windows = TrajectoryBatch(
        position=states,
        velocity=states,
        control=jax.ShapeDtypeStruct((1, _STEPS, model.control_size), jnp.float32),
        contact=None,
        nodes=jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape), leaf.dtype), nodes),
        steps=jax.ShapeDtypeStruct((1,), int),
    )
    arrays, static = eqx.partition(model, eqx.is_inexact_array)

    def loss(arrays: ContactDynamics, windows: TrajectoryBatch[jax.Array]) -> jax.Array:
        whole = eqx.combine(arrays, static)
        terms = window_loss(whole, windows, jax.random.key(0))
        if with_rollout:
            terms = replace(terms, rollout=rollout_loss(whole, windows))
        return terms.total(LossTerms())

    began = time.perf_counter()
    compiled = jax.jit(jax.value_and_grad(loss)).lower(arrays, windows).compile()
    planned = compiled.memory_analysis()
    asked = planned.temp_size_in_bytes + planned.argument_size_in_bytes
    return {
        "objects": count,
        "steps": _STEPS,
        "edges": "all pairs" if model.neighbor_list is None else "listed",
        "rollout term": "yes" if with_rollout else "no",
        "memory GiB": (asked + planned.output_size_in_bytes) / 2**30,
        "compile s": time.perf_counter() - began,
    }


def main() -> None:
    """Measure and print."""
    options = arguments("Memory of a step of training.")
    model = load_model(shipped_model("pickup")).model
    counts = (100,) if options.quick else (100, 300, 1000)
    rows = [measured(model, count, False) for count in counts]
    rows += [
        measured(listing(model, count), count, rollout)
        for count in counts
        for rollout in (False, True)
    ]
    report("training_memory", rows, options)


if __name__ == "__main__":
    main()
