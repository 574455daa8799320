"""Time of a control step: correct the belief, plan, return the force.

Usage: python benchmarks/control_tick.py [--quick] [--json FILE]

Whole episodes of the pickup task, planned 20 steps ahead, and of the arm's, planned 50 (half a
second) ahead, with the shipped models; the arm's need the extra ``mujoco``. Compilation happens in
`ActiveSetMPC.reset`; it is timed and counted apart, and a tick that compiled would show in the last
column. Ticks are made `pin_to_core`.

The rows named "bystanders" are pickups with as many nodes as the row says, of which all but two
stand off the ways, no less dense than the task's own. Each of their ticks is made for every number
of nodes, one after the other, so that ratios are of the same moment of the same motion, with the
machine in the same mood; ``differs`` is by how much a force differs from that with two nodes.
"""

import time
from dataclasses import dataclass, field
from importlib.util import find_spec

import jax.numpy as jnp
import numpy as np
from measuring import Compilations, arguments, report

from contactgraph.control import (
    ILQR,
    ActiveSetMPC,
    ControlLimits,
    MPCState,
    QuadraticCost,
    chain_cost,
    pin_to_core,
)
from contactgraph.envs import PickupTask
from contactgraph.envs.gripper_task import GripperTask
from contactgraph.envs.pickup_layout import CLEARANCE, CORRIDOR, RADIUS, distance_to_ways
from contactgraph.evaluate import episode_seeds
from contactgraph.model import ContactDynamics, Nodes, load_model, scene_nodes, shipped_model

Row = dict[str, float | int | str]
DENSITY = 5.0
"""Bystanders a square metre: 20 in the task's square of 2 m."""


def controller(model: ContactDynamics, task: GripperTask, horizon: int) -> ActiveSetMPC:
    """With at most five rollouts a tick."""
    limits = ControlLimits(jnp.asarray(task.action_space.low), jnp.asarray(task.action_space.high))
    return ActiveSetMPC(model, ILQR(horizon=horizon, iterations=5, limits=limits))


def cost_of(task: GripperTask, goal: np.ndarray, nodes: int) -> QuadraticCost:
    """The task's own, in a scene of so many nodes."""
    terms, control_size = task.cost_terms(), len(task.action_space.low)
    weights = terms.pick_weights, terms.goal_weights, terms.control_weight
    return chain_cost(terms.chain, *weights, goal, nodes, control_size)


@dataclass
class Ticks:
    """What is measured of a controller in one kind of scene."""

    mpc: ActiveSetMPC
    heard: Compilations
    milliseconds: list[float] = field(default_factory=list)
    in_play: list[int] = field(default_factory=list)
    compile_s: float = 0.0
    at_reset: int = 0
    in_ticks: int = 0

    def reset(self, observation: dict, nodes: Nodes, cost: QuadraticCost) -> MPCState:
        """The first one compiles."""
        before, began = self.heard.count, time.perf_counter()
        state = self.mpc.reset(observation, nodes, cost)
        if not self.milliseconds:
            self.compile_s = time.perf_counter() - began
            self.at_reset = self.heard.count - before
        return state

    def step(self, observation: dict, state: MPCState) -> tuple[np.ndarray, MPCState]:
        """The force, N, and the state after it."""
        before, began = self.heard.count, time.perf_counter()
        plan, state = self.mpc.step(observation, observation["contact"], state)
        force = np.asarray(plan.controls)[0]  # waits for the plan
        self.milliseconds.append(1e3 * (time.perf_counter() - began))
        self.in_play.append(int(np.sum(np.asarray(plan.node_ids) >= 0)))
        self.in_ticks += self.heard.count - before
        return force, state

    def row(self, name: str, nodes: int, times: float, differs: float | str) -> Row:
        """As a row of the table."""
        p50, p99, p999 = np.percentile(self.milliseconds, [50, 99, 99.9])
        return {
            "task": name,
            "nodes": nodes,
            "in play": float(np.mean(self.in_play)),
            "ticks": len(self.milliseconds),
            "p50 ms": float(p50),
            "p99 ms": float(p99),
            "p99.9 ms": float(p999),
            "times 2": times,
            "differs N": differs,
            "compile s": self.compile_s,
            "compilations": self.at_reset,
            "in ticks": self.in_ticks,
        }


def of_task(
    model: ContactDynamics,
    tasks: list[GripperTask],
    horizon: int,
    episodes: int,
    heard: Compilations,
) -> list[Row]:
    """A row a task, over several episodes, each with another layout and goal."""
    rows: list[Row] = []
    least = 0.0
    for task in tasks:
        ticks = Ticks(controller(model, task, horizon), heard)
        for seed in episode_seeds(episodes, seed=0):
            observation, _ = task.reset(seed=seed)
            count = task.scene.node_count
            cost = cost_of(task, observation["goal"], count)
            state = ticks.reset(observation, scene_nodes(task.scene), cost)
            with pin_to_core():
                for _ in range(task.max_steps):
                    force, state = ticks.step(observation, state)
                    observation, *_ = task.step(force)
        median = float(np.median(ticks.milliseconds))
        least = least or median
        rows.append(ticks.row(str(task.scene.metadata["task"]), count, median / least, ""))
    return rows


def among(observation: dict, bystanders: np.ndarray) -> dict:
    """What is observed, with bystanders at rest besides."""
    rest = np.zeros_like(bystanders)
    own = len(observation["position"])
    contact = np.zeros((own + len(bystanders),) * 2, np.int8)
    contact[:own, :own] = observation["contact"]
    return {
        "position": np.concatenate([observation["position"], bystanders]),
        "velocity": np.concatenate([observation["velocity"], rest]),
        "contact": contact,
    }


def bystanders_around(stops: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """[count, 2] m, off the ways between the ``stops`` [S, 2] m, and off each other."""
    half = 0.5 * np.sqrt(max(count, 20) / DENSITY)
    placed = np.zeros((0, 2))
    while len(placed) < count:
        point = rng.uniform(-half, half, 2)
        gaps = np.linalg.norm(placed - point, axis=1)
        if np.all(gaps >= 2 * RADIUS + CLEARANCE) and distance_to_ways(point, stops) >= CORRIDOR:
            placed = np.concatenate([placed, point[None]])
    return placed


def with_bystanders(
    model: ContactDynamics, sizes: list[int], episodes: int, heard: Compilations
) -> list[Row]:
    """A row a number of nodes, two of which are in play; the first is to have no others."""
    task = PickupTask()
    all_ticks = [Ticks(controller(model, task, 20), heard) for _ in sizes]
    differs = np.zeros(len(sizes))
    for seed in episode_seeds(episodes, seed=0):
        observation, _ = task.reset(seed=seed)
        stops = np.concatenate([observation["position"], observation["goal"][None]])
        rng = np.random.default_rng(seed)
        around = [bystanders_around(stops, size - 2, rng) for size in sizes]
        states = [
            ticks.reset(
                among(observation, others),
                Nodes(
                    actuated=jnp.asarray(np.arange(size) == 0),
                    mask=jnp.ones(size, bool),
                    candidate=jnp.ones(size * (size - 1) // 2, bool),
                ),
                cost_of(task, observation["goal"], size),
            )
            for ticks, others, size in zip(all_ticks, around, sizes, strict=True)
        ]
        with pin_to_core():
            for step in range(task.max_steps):
                seen = [among(observation, others) for others in around]
                forces: dict[int, np.ndarray] = {}
                for index in np.roll(range(len(sizes)), step).tolist():
                    forces[index], states[index] = all_ticks[index].step(seen[index], states[index])
                apart = [np.max(np.abs(forces[index] - forces[0])) for index in range(len(sizes))]
                differs = np.maximum(differs, apart)
                observation, *_ = task.step(forces[0])
    first = np.array(all_ticks[0].milliseconds)
    return [
        ticks.row("bystanders", size, float(np.median(ticks.milliseconds / first)), float(apart))
        for ticks, size, apart in zip(all_ticks, sizes, differs, strict=True)
    ]


def main() -> None:
    """Measure and print."""
    options = arguments("Time of a control tick.")
    episodes = 1 if options.quick else 10
    heard = Compilations()
    model = load_model(shipped_model("pickup")).model
    rows = with_bystanders(model, [2, 11, 100, 1000], episodes, heard)
    rows += of_task(model, [PickupTask(n - 2) for n in (2, 11, 21)], 20, 5 * episodes, heard)
    if find_spec("mujoco") is not None:
        from contactgraph_franka.envs.franka_task import FrankaTask

        model = load_model(shipped_model("franka")).model
        rows += of_task(model, [FrankaTask(n - 2) for n in (2, 7)], 50, episodes, heard)
    report("control_tick", rows, options)


if __name__ == "__main__":
    main()
