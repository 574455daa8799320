"""Time of a control step: correct the belief, plan, return the force.

Usage: python benchmarks/control_tick.py [--quick] [--json FILE]

Whole episodes of the pickup task (horizon 20) and of the arm's (horizon 50, half a second), with
the shipped models; the arm's need the extra ``mujoco``. `ActiveSetMPC.reset` compiles; its time and
count are separate, and compilations during control steps appear in the last column. Control steps
run under `pin_to_core`, compiled after `compile_small_loops`.

The rows "bystanders" are pickups with distractors away from the paths, as dense as the task's own.
Each control step is computed for every number of nodes in turn, so that ratios compare the same
state under the same load; ``differs`` is the largest difference of a force from the first row's.
"""

import time
from dataclasses import dataclass, field
from importlib.util import find_spec

import jax.numpy as jnp
import numpy as np
from measuring import Compilations, arguments, report

from contactgraph.control import (
    ILQR,
    MPC,
    ActiveSetMPC,
    ControlLimits,
    MPCState,
    QuadraticCost,
    chain_cost,
    compile_small_loops,
    pin_to_core,
)
from contactgraph.envs import PickupTask
from contactgraph.envs.gripper_task import GripperTask
from contactgraph.envs.pickup_layout import CLEARANCE, CORRIDOR, RADIUS, distance_to_paths
from contactgraph.evaluate import episode_seeds
from contactgraph.model import ContactDynamics, Nodes, load_model, scene_nodes, shipped_model

Row = dict[str, float | int | str]
DENSITY = 5.0
"""Distractors per square metre: 20 in the task's square of 2 m."""


def controller(model: ContactDynamics, task: GripperTask, horizon: int) -> ActiveSetMPC:
    """A controller with at most five rollouts per control step."""
    limits = ControlLimits(jnp.asarray(task.action_space.low), jnp.asarray(task.action_space.high))
    return ActiveSetMPC(MPC(model, ILQR(horizon=horizon, iterations=5, limits=limits)))


def cost_of(task: GripperTask, goal: np.ndarray, nodes: int) -> QuadraticCost:
    """The task's cost in a scene of ``nodes`` nodes."""
    terms, control_size = task.cost_terms(), len(task.action_space.low)
    weights = terms.pick_weights, terms.goal_weights, terms.control_weight
    return chain_cost(terms.chain, *weights, goal, nodes, control_size)


@dataclass
class StepTimes:
    """Measurements of a controller in one type of scene."""

    mpc: ActiveSetMPC
    compilations: Compilations
    milliseconds: list[float] = field(default_factory=list)
    active_nodes: list[int] = field(default_factory=list)
    compile_s: float = 0.0
    at_reset: int = 0
    in_steps: int = 0

    def reset(self, observation: dict, nodes: Nodes, cost: QuadraticCost) -> MPCState:
        """Resets the controller; the first call compiles."""
        before, began = self.compilations.count, time.perf_counter()
        state = self.mpc.reset(observation, nodes, cost)
        if not self.milliseconds:
            self.compile_s = time.perf_counter() - began
            self.at_reset = self.compilations.count - before
        return state

    def step(self, observation: dict, state: MPCState) -> tuple[np.ndarray, MPCState]:
        """The force, N, and the state after it."""
        before, began = self.compilations.count, time.perf_counter()
        plan, state = self.mpc.step(observation, observation["contact"], state)
        force = np.asarray(plan.controls)[0]  # waits for the plan
        self.milliseconds.append(1e3 * (time.perf_counter() - began))
        self.active_nodes.append(int(np.sum(np.asarray(plan.node_ids) >= 0)))
        self.in_steps += self.compilations.count - before
        return force, state

    def row(self, name: str, nodes: int, times: float, differs: float | str) -> Row:
        """A row of the table."""
        p50, p99, p999 = np.percentile(self.milliseconds, [50, 99, 99.9])
        return {
            "task": name,
            "nodes": nodes,
            "in play": float(np.mean(self.active_nodes)),
            "ticks": len(self.milliseconds),
            "p50 ms": float(p50),
            "p99 ms": float(p99),
            "p99.9 ms": float(p999),
            "times 2": times,
            "differs N": differs,
            "compile s": self.compile_s,
            "compilations": self.at_reset,
            "in ticks": self.in_steps,
        }


def of_task(
    model: ContactDynamics,
    tasks: list[GripperTask],
    horizon: int,
    episodes: int,
    compilations: Compilations,
) -> list[Row]:
    """One row per task, over several episodes, each with another layout and goal."""
    rows: list[Row] = []
    least = 0.0
    for task in tasks:
        times = StepTimes(controller(model, task, horizon), compilations)
        for seed in episode_seeds(episodes, seed=0):
            observation, _ = task.reset(seed=seed)
            count = task.scene.node_count
            cost = cost_of(task, observation["goal"], count)
            state = times.reset(observation, scene_nodes(task.scene), cost)
            with pin_to_core():
                for _ in range(task.max_steps):
                    force, state = times.step(observation, state)
                    observation, *_ = task.step(force)
        median = float(np.median(times.milliseconds))
        least = least or median
        rows.append(times.row(str(task.scene.metadata["task"]), count, median / least, ""))
    return rows


def among(observation: dict, distractors: np.ndarray) -> dict:
    """The observation with additional distractors at rest."""
    rest = np.zeros_like(distractors)
    own = len(observation["position"])
    contact = np.zeros((own + len(distractors),) * 2, np.int8)
    contact[:own, :own] = observation["contact"]
    return {
        "position": np.concatenate([observation["position"], distractors]),
        "velocity": np.concatenate([observation["velocity"], rest]),
        "contact": contact,
    }


def distractors_around(stops: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """[count, 2] m, away from the paths between the ``stops`` [S, 2] m and from each other."""
    half = 0.5 * np.sqrt(max(count, 20) / DENSITY)
    placed = np.zeros((0, 2))
    while len(placed) < count:
        point = rng.uniform(-half, half, 2)
        gaps = np.linalg.norm(placed - point, axis=1)
        if np.all(gaps >= 2 * RADIUS + CLEARANCE) and distance_to_paths(point, stops) >= CORRIDOR:
            placed = np.concatenate([placed, point[None]])
    return placed


def with_distractors(
    model: ContactDynamics, sizes: list[int], episodes: int, compilations: Compilations
) -> list[Row]:
    """One row per number of nodes, two of which are active; the first has no others."""
    task = PickupTask()
    all_times = [StepTimes(controller(model, task, 20), compilations) for _ in sizes]
    differs = np.zeros(len(sizes))
    for seed in episode_seeds(episodes, seed=0):
        observation, _ = task.reset(seed=seed)
        stops = np.concatenate([observation["position"], observation["goal"][None]])
        rng = np.random.default_rng(seed)
        around = [distractors_around(stops, size - 2, rng) for size in sizes]
        states = [
            times.reset(
                among(observation, others),
                Nodes(
                    actuated=jnp.asarray(np.arange(size) == 0),
                    mask=jnp.ones(size, bool),
                    candidate=jnp.ones(size * (size - 1) // 2, bool),
                ),
                cost_of(task, observation["goal"], size),
            )
            for times, others, size in zip(all_times, around, sizes, strict=True)
        ]
        with pin_to_core():
            for step in range(task.max_steps):
                observations = [among(observation, others) for others in around]
                forces: dict[int, np.ndarray] = {}
                for index in np.roll(range(len(sizes)), step).tolist():
                    forces[index], states[index] = all_times[index].step(
                        observations[index], states[index]
                    )
                apart = [np.max(np.abs(forces[index] - forces[0])) for index in range(len(sizes))]
                differs = np.maximum(differs, apart)
                observation, *_ = task.step(forces[0])
    first = np.array(all_times[0].milliseconds)
    return [
        times.row("bystanders", size, float(np.median(times.milliseconds / first)), float(apart))
        for times, size, apart in zip(all_times, sizes, differs, strict=True)
    ]


def main() -> None:
    """Measure and print."""
    compile_small_loops()
    options = arguments("Time of a control step.")
    episodes = 1 if options.quick else 10
    compilations = Compilations()
    model = load_model(shipped_model("pickup")).model
    rows = with_distractors(model, [2, 11, 100, 1000], episodes, compilations)
    rows += of_task(model, [PickupTask(n - 2) for n in (2, 11, 21)], 20, 5 * episodes, compilations)
    if find_spec("mujoco") is not None:
        from contactgraph_franka.envs.franka_task import FrankaTask

        model = load_model(shipped_model("franka")).model
        rows += of_task(model, [FrankaTask(n - 2) for n in (2, 7)], 50, episodes, compilations)
    report("control_tick", rows, options)


if __name__ == "__main__":
    main()
