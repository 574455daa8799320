"""Plans of many scenes: side by side on one device, and one after the other.

Usage: python benchmarks/batched_planning.py [--quick] [--json FILE]

Pickup among nine distractors (eleven nodes), the shipped model, iLQR over 20 steps with at most
five rollouts from no force, from the first state of each scene. Side by side is one call:
`jax.lax.map` over chunks of scenes under `vmap`. One alone is a call for one scene; the ratio is
that of all scenes one after the other to all in one call. Medians of interleaved calls,
milliseconds; the device is JAX's default one. The difference is that of plans' costs, as a part
of each, where the same scenes are planned one by one on the CPU with the full precision of
products: its median, its 99th percentile, and the part of scenes within one percent.
"""

from collections.abc import Iterator
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measuring import Row, arguments, medians, report

import contactgraph
from contactgraph.control import ILQR, ControlLimits, QuadraticCost
from contactgraph.model import ModelState, Nodes, scene_nodes
from contactgraph.policies import TaskCost

HORIZON, ITERATIONS, DISTRACTORS = 20, 5, 9
CHECKED = 100
"""Scenes planned again on the CPU."""
Scene = tuple[np.ndarray, np.ndarray, QuadraticCost]
"""Positions, m, velocities, m/s, and the cost."""


def scenes_of(count: int) -> tuple[Scene, Nodes, ControlLimits]:
    """First states and costs, along the first axis; the nodes are the same in all."""
    task = contactgraph.make("pickup", distractors=DISTRACTORS)
    box = task.action_space
    drawn = []
    for seed in range(count):
        observation, _ = task.reset(seed=seed)
        cost = TaskCost(task.cost_terms(), len(box.low), task.cost_terms).in_scene(task.scene)
        scene = observation["position"], observation["velocity"], cost.quadratic(DISTRACTORS + 2)
        drawn.append(jax.tree.map(np.asarray, scene))
    limits = ControlLimits(jnp.asarray(box.low), jnp.asarray(box.high))
    scenes = jax.tree.map(lambda *leaves: np.stack(leaves), *drawn)
    return scenes, scene_nodes(task.scene), limits


def measure(
    counts_chunks: list[tuple[int, int]], rounds: int, precision: str | None
) -> Iterator[Row]:
    """A row for each number of scenes and of scenes in a chunk."""
    most = max(count for count, _ in counts_chunks)
    scenes, nodes, limits = scenes_of(most)
    whole = contactgraph.load("pickup"), nodes, ILQR(HORIZON, ITERATIONS, limits)
    arrays, static = eqx.partition(whole, eqx.is_array)

    def planned(arrays, scene: Scene) -> tuple[jax.Array, jax.Array]:
        model, nodes, planner = eqx.combine(arrays, static)
        position, velocity, cost = scene
        belief = model.initial_belief(position, velocity, nodes)
        plan = planner.solve(model, ModelState(position, velocity, belief), nodes, cost)
        return plan.cost, plan.controls

    first = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), scenes)
    alone = partial(jax.jit(planned), arrays, first)
    expected = on_the_cpu(planned, arrays, scenes, min(CHECKED, most))
    for count, chunk in counts_chunks:
        given = jax.tree.map(lambda leaf, count=count: jnp.asarray(leaf[:count]), scenes)
        side_by_side = jax.jit(
            lambda arrays, given, chunk=chunk: jax.lax.map(
                lambda scene: planned(arrays, scene), given, batch_size=chunk
            )
        )
        together = partial(side_by_side, arrays, given)
        taken = medians({"together": together, "alone": alone}, rounds)
        costs = np.asarray(together()[0])[: len(expected)]
        apart = np.abs(costs - expected[: len(costs)]) / expected[: len(costs)]
        yield {
            "products": precision or "default",
            "scenes": count,
            "chunk": chunk,
            "together ms": taken["together"],
            "ms a plan": taken["together"] / count,
            "one alone ms": taken["alone"],
            "ratio": count * taken["alone"] / taken["together"],
            "difference p50": f"{np.median(apart):.0e}",
            "p99": f"{np.percentile(apart, 99):.0e}",
            "within 1 %": float(np.mean(apart < 0.01)),
        }


def on_the_cpu(planned, arrays, scenes: Scene, count: int) -> np.ndarray:
    """Costs of the plans of the first scenes, one by one."""
    cpu = jax.devices("cpu")[0]
    with jax.default_device(cpu), jax.default_matmul_precision("highest"):
        arrays = jax.device_put(arrays, cpu)
        plan = jax.jit(lambda arrays, scene: planned(arrays, scene)[0])
        rows = (jax.tree.map(lambda leaf, i=i: leaf[i], scenes) for i in range(count))
        return np.array([float(plan(arrays, row)) for row in rows])


def main() -> None:
    """Measure and print."""
    options = arguments("Plans of many scenes.")
    on_cpu = jax.default_backend() == "cpu"
    sizes = [(1000, 1), (1000, 16)] if on_cpu else [(100, 100), (1000, 1000), (10_000, 10_000)]
    if options.quick:
        sizes = [(16, 4)]
    rows = []
    for precision in (None,) if on_cpu else ("highest", None):
        with jax.default_matmul_precision(precision):
            for row in measure(sizes, 3, precision):
                rows.append(row)
                print(row, flush=True)
    report("batched_planning", rows, options)


if __name__ == "__main__":
    main()
