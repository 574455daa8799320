"""How long a control tick takes: correct the belief, plan ahead, hand over the force.

Usage: python benchmarks/control_tick.py [--quick] [--json FILE]

Whole episodes of the pickup task, planned 20 steps ahead, and of the arm's, planned 50 (half a
second) ahead, with the shipped models; the arm's need the extra ``mujoco``. Compilation happens in
`MPC.reset`; it is timed and counted apart, and a tick that compiled would show in the last column.
"""

import time
from importlib.util import find_spec

import jax.numpy as jnp
import numpy as np
from measuring import Compilations, arguments, report

from contactgraph.control import ILQR, MPC, ControlLimits, chain_cost
from contactgraph.evaluate import episode_seeds
from contactgraph.model import ContactDynamics, load_model, scene_nodes, shipped_model
from contactgraph.tasks import PickupTask
from contactgraph.tasks.gripper_task import GripperTask


def measured(
    model: ContactDynamics, task: GripperTask, horizon: int, episodes: int, compiled: Compilations
) -> dict[str, float | int | str]:
    """One row: ticks over several episodes, each with another layout and goal."""
    limits = ControlLimits(jnp.asarray(task.action_space.low), jnp.asarray(task.action_space.high))
    mpc = MPC(model, ILQR(horizon=horizon, iterations=5, limits=limits))
    compile_s, at_reset, in_ticks = 0.0, 0, 0
    milliseconds: list[float] = []
    for number, seed in enumerate(episode_seeds(episodes, seed=0)):
        observation, _ = task.reset(seed=seed)
        nodes = task.scene.node_count
        terms = task.cost_terms()
        cost = chain_cost(
            terms.chain,
            terms.pick_weights,
            terms.goal_weights,
            terms.control_weight,
            observation["goal"],
            nodes,
            len(task.action_space.low),
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
        "task": str(task.scene.metadata["task"]),
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
    episodes = 1 if told.quick else 10
    compiled = Compilations()
    model = load_model(shipped_model("pickup")).model
    rows = [measured(model, PickupTask(n - 2), 20, episodes, compiled) for n in (2, 4, 12, 21)]
    if find_spec("mujoco") is not None:
        from contactgraph.tasks.mujoco import FrankaTask

        model = load_model(shipped_model("franka")).model
        rows += [measured(model, FrankaTask(n - 2), 50, episodes, compiled) for n in (2, 7)]
    report("control_tick", rows, told)


if __name__ == "__main__":
    main()
