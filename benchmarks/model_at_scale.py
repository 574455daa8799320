"""One step of the model in scenes of growing size: every pair an edge, or lists of near pairs.

Usage: python benchmarks/model_at_scale.py [--quick] [--json FILE]

A step as a rollout makes it, from crowds of one density. Lists are made again in each step; the
time of that alone stands beside it. "By groups": every pair an edge, but solved by groups, as
lists are: what the lists alone are worth. Medians of calls in turns, milliseconds, those with lists
apart from the others, which leave nothing of them in the caches; a single
call of the largest scene with every pair an edge. The difference is that of predicted positions.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measuring import arguments, medians, report

from contactgraph.bodies.geometry import travel_bound
from contactgraph.data import pair_indices
from contactgraph.large_scenes import NeighborList
from contactgraph.model import (
    ContactDynamics,
    ModelState,
    Nodes,
    load_model,
    shipped_model,
    take_step,
)

_ALL_PAIRS = 1000
"""Objects up to which every pair is an edge, too; a single call from here on."""

_SPACING = 0.15
"""m, the spacing of a grid of objects, displaced by up to a third of it: a tenth touch."""
_SPEED = 0.2
"""m/s"""

Call = Callable[[], ModelState]


def crowd(count: int, seed: int = 0) -> tuple[jax.Array, jax.Array, Nodes]:
    """Positions [m] and velocities [m/s] of objects; the first is actuated."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:count]
    position = _SPACING * (grid + rng.uniform(-1 / 3, 1 / 3, grid.shape))
    velocity = _SPEED * rng.normal(size=grid.shape)
    nodes = Nodes(
        actuated=jnp.arange(count) == 0,
        mask=jnp.ones(count, bool),
        candidate=jnp.ones(len(pair_indices(count)), bool),
    )
    return jnp.asarray(position, jnp.float32), jnp.asarray(velocity, jnp.float32), nodes


def listing(model: ContactDynamics, count: int) -> ContactDynamics:
    """The same model with a list capacity of about 1.5 times the near pairs."""
    return replace(model, neighbor_list=NeighborList(max_edges=5 * count, cell_capacity=12))


def step_call(model: ContactDynamics, count: int) -> Call:
    """One step of a crowd."""
    position, velocity, nodes = crowd(count)
    belief = eqx.filter_jit(model.initial_belief)(position, velocity, nodes)
    arrays, static = eqx.partition(model, eqx.is_array)

    @jax.jit
    def step(arrays: ContactDynamics, state: ModelState) -> ModelState:
        whole = eqx.combine(arrays, static)
        return take_step(whole, state, jnp.ones(model.control_size), nodes)[0]

    return partial(step, arrays, ModelState(position, velocity, belief))


def list_call(model: ContactDynamics, count: int) -> Callable[[], object]:
    """The list of that step alone."""
    position, velocity, nodes = crowd(count)
    push = jnp.zeros_like(velocity)

    @jax.jit
    def made(position: jax.Array, velocity: jax.Array) -> object:
        way = travel_bound(position, velocity, push, None, model.dt)
        return model.neighbor_list(position, way, nodes.mask, model.cutoff.outer)

    return partial(made, position, velocity)


def measured(model: ContactDynamics, count: int, rounds: int) -> dict[str, float | int | str]:
    """One row."""
    near = listing(model, count)
    pairs = len(pair_indices(count))
    listed = step_call(near, count)
    calls = {"list": list_call(near, count), "listed": listed}
    row: dict[str, float | int | str] = {
        "objects": count,
        "pairs": pairs,
        "near": int(jnp.sum(listed().belief.edge_id < pairs)),
    }
    # Separate, since the other calls evict the caches.
    taken = medians(calls, rounds)
    if count > _ALL_PAIRS:
        return row | {
            "list": taken["list"],
            "step": taken["listed"],
            "all pairs": "",
            "by groups": "",
            "ratio": "",
            "ratio by groups": "",
            "difference m": "",
        }
    every = step_call(model, count)
    lists = NeighborList(max_edges=pairs, cell_capacity=near.neighbor_list.cell_capacity)
    groups = step_call(replace(model, neighbor_list=lists), count)
    if count < _ALL_PAIRS:
        taken |= medians({"by groups": groups, "every": every}, rounds)
    else:
        taken |= medians({"by groups": groups}, 3) | medians({"every": every}, 1)
    apart = jnp.max(jnp.abs(every().position - listed().position))
    return row | {
        "list": taken["list"],
        "step": taken["listed"],
        "all pairs": taken["every"],
        "by groups": taken["by groups"],
        "ratio": taken["every"] / taken["listed"],
        "ratio by groups": taken["by groups"] / taken["listed"],
        "difference m": f"{float(apart):.0e}",
    }


def main() -> None:
    """Measure and print."""
    options = arguments("One step of the model in scenes of growing size.")
    model = load_model(shipped_model("pickup")).model
    counts = (12, 50) if options.quick else (12, 25, 50, 100, 300, 1000, 3000)
    rows = [measured(model, count, 3 if options.quick else 15) for count in counts]
    report("model_at_scale", rows, options)


if __name__ == "__main__":
    main()
