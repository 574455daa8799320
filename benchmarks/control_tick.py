"""How long a control tick takes: correct the belief, plan 20 steps, hand over the force.

Usage: python benchmarks/control_tick.py [--quick] [--json FILE]

Whole episodes of the pickup task with the shipped model. Compilation happens in `MPC.reset`; it
is timed and counted apart, and a tick that compiled would show in the last column.
"""

import time

import jax.numpy as jnp
import numpy as np
from measuring import Compilations, arguments, report

from contactgraph.control import ILQR, MPC, ControlLimits, chain_cost
from contactgraph.evaluate import episode_seeds, scene_nodes
from contactgraph.model import ContactDynamics, load_model, shipped_model
from contactgraph.tasks import PickupTask

HORIZON = 20


def measured(
    model: ContactDynamics, nodes: int, episodes: int, compiled: Compilations
) -> dict[str, float | int]:
    """One row: ticks over several episodes, each with another layout and goal."""
    task = PickupTask(distractors=nodes - 2)
    limits = ControlLimits(jnp.asarray(task.action_space.low), jnp.asarray(task.action_space.high))
    mpc = MPC(model, ILQR(horizon=HORIZON, iterations=5, limits=limits))
    compile_s, at_reset, in_ticks = 0.0, 0, 0
    milliseconds: list[float] = []
    for number, seed in enumerate(episode_seeds(episodes, seed=0)):
        observation, _ = task.reset(seed=seed)
        terms = task.cost_terms()
        cost = chain_cost(
            terms.chain,
            terms.pick_weights,
            terms.goal_weights,
            terms.control_weight,
            observation["goal"],
            nodes,
        )
        before, began = compiled.count, time.perf_counter()
        state = mpc.reset(observation, scene_nodes(task.scene), cost)
        if number == 0:
            compile_s, at_reset = time.perf_counter() - began, compiled.count - before
        before = compiled.count
        for _ in range(task.max_steps):
            began = time.perf_counter()
            plan, state = mpc.step(observation, observation["contact"], state)
            force = np.asarray(plan.controls)[0]  # waits for the plan
            milliseconds.append(1e3 * (time.perf_counter() - began))
            observation, *_ = task.step(force)
        in_ticks += compiled.count - before
    p50, p99, p999 = np.percentile(milliseconds, [50, 99, 99.9])
    return {
        "nodes": nodes,
        "edges": nodes * (nodes - 1) // 2,
        "ticks": len(milliseconds),
        "p50 ms": float(p50),
        "p99 ms": float(p99),
        "p99.9 ms": float(p999),
        "compile s": compile_s,
        "compilations": at_reset,
        "in ticks": in_ticks,
    }


def main() -> None:
    """Measure and say."""
    told = arguments("Time of a control tick.")
    model = load_model(shipped_model("pickup")).model
    episodes = 1 if told.quick else 10
    compiled = Compilations()
    rows = [measured(model, nodes, episodes, compiled) for nodes in (2, 4, 12, 21)]
    report("control_tick", rows, told)


if __name__ == "__main__":
    main()
