"""One step of the model in scenes of growing size: every pair an edge, or lists of near pairs.

Usage: python benchmarks/model_at_scale.py [--quick] [--json FILE]

A step as a rollout makes it, from crowds of one density. Lists are made anew in each step; the
time of that alone stands beside it. "By groups": every pair an edge, but solved by groups, as
lists are: what the lists alone are worth. Medians of calls in turns, milliseconds, those with lists
apart from the others, which leave nothing of them in the caches; a single
call of the largest scene with every pair an edge. The difference is that of predicted positions.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from crowds import crowd, listing
from measuring import arguments, report

from contactgraph.data import pair_indices
from contactgraph.model import (
    ContactDynamics,
    ModelState,
    NeighborList,
    load_model,
    shipped_model,
    take_step,
)
from contactgraph.model.neighbor_list import travel_bound

_ALL_PAIRS = 1000
"""Objects up to which every pair is an edge, too; a single call from here on."""

Call = Callable[[], ModelState]


def medians(calls: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Milliseconds of each call, by name; the calls take turns."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        jax.block_until_ready(call())
    for _ in range(rounds):
        for name, call in calls.items():
            began = time.perf_counter()
            jax.block_until_ready(call())
            times[name].append(1e3 * (time.perf_counter() - began))
    return {name: float(np.median(taken)) for name, taken in times.items()}


def step_call(model: ContactDynamics, count: int) -> Call:
    """One step of a crowd."""
    position, velocity, nodes = crowd(count)
    belief = eqx.filter_jit(model.initial_belief)(position, velocity, nodes)
    arrays, static = eqx.partition(model, eqx.is_array)
    response = jnp.zeros((*position.shape, model.control_size))

    @jax.jit
    def step(arrays: ContactDynamics, state: ModelState) -> ModelState:
        whole = eqx.combine(arrays, static)
        return take_step(whole, state, response, jnp.ones(model.control_size), nodes)[0]

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
    # Apart from the others, which leave nothing of it in the caches.
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
    """Measure and say."""
    told = arguments("One step of the model in scenes of growing size.")
    model = load_model(shipped_model("pickup")).model
    counts = (12, 50) if told.quick else (12, 25, 50, 100, 300, 1000, 3000)
    rows = [measured(model, count, 3 if told.quick else 15) for count in counts]
    report("model_at_scale", rows, told)


if __name__ == "__main__":
    main()
