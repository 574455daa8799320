"""Rollouts of many scenes: side by side, and one after the other.

Usage: python benchmarks/batched_rollouts.py [--quick] [--json FILE]

200 steps from crowds of one density, beginning with the first belief. Side by side is one call:
`jax.lax.map` over chunks of scenes under `vmap`. One alone is a call for one scene; the ratio is
that of all scenes one after the other to all in one call. Medians of
interleaved calls, milliseconds. The difference is that of the first scene's positions.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measuring import arguments, medians, report
from model_at_scale import crowd

from contactgraph.model import ContactDynamics, ModelState, load_model, shipped_model


def measured(
    model: ContactDynamics, count: int, scenes: int, steps: int, chunk: int, rounds: int
) -> dict[str, float | int | str]:
    """One row."""
    drawn = [crowd(count, seed) for seed in range(scenes)]
    nodes = drawn[0][2]
    rng = np.random.default_rng(0)
    controls = rng.normal(size=(scenes, steps, model.control_size)).astype(np.float32)
    given = (
        jnp.stack([scene[0] for scene in drawn]),
        jnp.stack([scene[1] for scene in drawn]),
        jnp.asarray(controls),
    )
    arrays, static = eqx.partition(model, eqx.is_array)

    def rolled(arrays, position, velocity, controls):
        whole = eqx.combine(arrays, static)
        start = ModelState(position, velocity, whole.initial_belief(position, velocity, nodes))
        return whole.rollout(start, controls, nodes).position

    @jax.jit
    def all_rolled(arrays, *given):
        return jax.lax.map(lambda one: rolled(arrays, *one), given, batch_size=chunk)

    one_rolled = jax.jit(rolled)
    first = [values[0] for values in given]
    taken = medians(
        {
            "together": lambda: all_rolled(arrays, *given),
            "alone": lambda: one_rolled(arrays, *first),
        },
        rounds,
    )
    apart = jnp.max(jnp.abs(all_rolled(arrays, *given)[0] - one_rolled(arrays, *first)))
    return {
        "objects": count,
        "scenes": scenes,
        "steps": steps,
        "chunk": chunk,
        "together ms": taken["together"],
        "one alone ms": taken["alone"],
        "ratio": scenes * taken["alone"] / taken["together"],
        "difference m": f"{float(apart):.0e}",
    }


def main() -> None:
    """Measure and print."""
    options = arguments("Rollouts of many scenes.")
    model = load_model(shipped_model("pickup")).model
    scenes, rounds = (100, 3) if options.quick else (1000, 7)
    rows = [
        measured(model, count, scenes, 200, chunk, rounds)
        for count, chunk in ((2, 64), (2, 250), (4, 64), (12, 16))
    ]
    report("batched_rollouts", rows, options)


if __name__ == "__main__":
    main()
