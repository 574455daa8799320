"""The model in large scenes and in many: steps by neighbour lists, batched rollouts, memory.

Usage: python benchmarks/model_at_scale.py [--quick] [--json FILE]

Three tables. One step of scenes of growing size, every pair an edge against lists of near pairs
made in the step, with the agreement of what they predict. Many scenes side by side against one
after the other. What the compiled step of training would take of memory, as XLA plans it; it is
not run. Times are medians of interleaved calls, in milliseconds.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measuring import arguments, report

from contactgraph.data.graph import pair_indices
from contactgraph.model import (
    ContactDynamics,
    ModelState,
    NeighbourLists,
    Nodes,
    advance,
    load_model,
    shipped_model,
)
from contactgraph.model.neighbours import longest_ways
from contactgraph.train.batch import Window
from contactgraph.train.loss import LossTerms, window_loss

_SPACING = 0.15
"""m; of a grid on which objects stand, each moved by up to a third of it: some touch."""
_SPEED = 0.2
"""m/s"""
_FULL_STEP = 300
"""Objects up to which every pair as an edge is measured more than once."""

Call = Callable[[], object]


def crowd(count: int, seed: int = 0) -> tuple[jax.Array, jax.Array, Nodes]:
    """Positions [m] and velocities [m/s] of objects at an equal density; one is actuated."""
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
    """The same model with lists that have room for scenes of this density."""
    return replace(model, neighbours=NeighbourLists(edges=5 * count, cell=12))


def medians(calls: dict[str, Call], rounds: int) -> dict[str, float]:
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
    """One step of a crowd, as a rollout makes it."""
    position, velocity, nodes = crowd(count)
    state = ModelState(position, velocity, eqx.filter_jit(model.initial_belief)(position, velocity, nodes))
    arrays, static = eqx.partition(model, eqx.is_array)
    response = jnp.zeros((*position.shape, model.control_size))

    @jax.jit
    def step(arrays: ContactDynamics, state: ModelState) -> ModelState:
        whole = eqx.combine(arrays, static)
        return advance(whole, state, response, jnp.ones(model.control_size), nodes)[0]

    return partial(step, arrays, state)


def list_call(model: ContactDynamics, count: int) -> Call:
    """The list of that step alone."""
    position, velocity, nodes = crowd(count)
    push = jnp.zeros_like(velocity)

    @jax.jit
    def made(position: jax.Array, velocity: jax.Array) -> object:
        way = longest_ways(position, velocity, push, None, model.dt)
        return model.neighbours(position, way, nodes.mask, model.reach.far)

    return partial(made, position, velocity)


def scene_row(model: ContactDynamics, count: int, rounds: int, full: bool) -> dict[str, object]:
    """One step of one scene."""
    near = listing(model, count)
    calls = {"list": list_call(near, count), "listed": step_call(near, count)}
    taken = medians(calls, rounds)
    edges = calls["list"]()
    row: dict[str, object] = {
        "objects": count,
        "pairs": len(pair_indices(count)),
        "near": int(jnp.sum(edges.number < len(pair_indices(count)))),
        "list ms": taken["list"],
        "step, listed ms": taken["listed"],
        "step, all pairs ms": float("nan"),
        "ratio": float("nan"),
        "largest difference m": float("nan"),
    }
    if full:
        every = step_call(model, count)
        taken |= medians({"full": every}, rounds if count <= _FULL_STEP else 1)
        apart = jnp.abs(every().position - calls["listed"]().position)
        row["step, all pairs ms"] = taken["full"]
        row["ratio"] = taken["full"] / taken["listed"]
        row["largest difference m"] = f"{float(jnp.max(apart)):.1e}"
    return row


def batch_row(model: ContactDynamics, count: int, scenes: int, steps: int, rounds: int) -> dict:
    """Rollouts of many scenes: all in one call, and one after the other."""
    drawn = [crowd(count, seed) for seed in range(scenes)]
    nodes = drawn[0][2]
    position, velocity = (jnp.stack([scene[part] for scene in drawn]) for part in (0, 1))
    controls = jnp.asarray(np.random.default_rng(0).normal(size=(scenes, steps, 2)), jnp.float32)
    arrays, static = eqx.partition(model, eqx.is_array)

    def rolled(arrays, position, velocity, controls):
        whole = eqx.combine(arrays, static)
        start = ModelState(position, velocity, whole.initial_belief(position, velocity, nodes))
        return whole.rollout(start, controls, nodes).position

    together = jax.jit(jax.vmap(rolled, in_axes=(None, 0, 0, 0)))
    alone = jax.jit(rolled)
    taken = medians(
        {
            "together": lambda: together(arrays, position, velocity, controls),
            "alone": lambda: alone(arrays, position[0], velocity[0], controls[0]),
        },
        rounds,
    )
    apart = together(arrays, position, velocity, controls)[0] - alone(
        arrays, position[0], velocity[0], controls[0]
    )
    return {
        "objects": count,
        "scenes": scenes,
        "steps": steps,
        "together ms": taken["together"],
        "one alone ms": taken["alone"],
        "ratio": scenes * taken["alone"] / taken["together"],
        "largest difference m": f"{float(jnp.max(jnp.abs(apart))):.1e}",
    }


def memory_row(model: ContactDynamics, count: int, steps: int, with_rollout: bool) -> dict:
    """What a step of training on one window takes, as XLA plans it."""
    position, velocity, nodes = crowd(count)
    states = jax.ShapeDtypeStruct((1, steps + 1, *position.shape), jnp.float32)
    windows = Window(
        position=states,
        velocity=states,
        control=jax.ShapeDtypeStruct((1, steps, model.control_size), jnp.float32),
        nodes=jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape), leaf.dtype), nodes),
    )
    arrays, static = eqx.partition(model, eqx.is_inexact_array)

    def loss(arrays: ContactDynamics, windows: Window) -> jax.Array:
        whole = eqx.combine(arrays, static)
        terms = window_loss(whole, windows, jax.random.key(0), with_rollout)
        return terms.total(LossTerms())

    began = time.perf_counter()
    compiled = jax.jit(jax.value_and_grad(loss)).lower(arrays, windows).compile()
    planned = compiled.memory_analysis()
    size = planned.temp_size_in_bytes + planned.argument_size_in_bytes
    return {
        "objects": count,
        "steps": steps,
        "edges": "all pairs" if model.neighbours is None else "listed",
        "rollout term": "yes" if with_rollout else "no",
        "memory GiB": (size + planned.output_size_in_bytes) / 2**30,
        "compile s": time.perf_counter() - began,
    }


def main() -> None:
    """Measure and say."""
    told = arguments("The model in large scenes, and in many.")
    model = load_model(shipped_model("pickup")).model
    counts = (12, 100) if told.quick else (12, 25, 50, 100, 300, 1000, 3000, 10000)
    rounds = 3 if told.quick else 15
    rows = [scene_row(model, count, rounds, full=count <= 1000) for count in counts]
    report("model_at_scale: one step", rows, told)


if __name__ == "__main__":
    main()
