"""Planners in the control loop of the arm in MuJoCo; time is simulated, plans come late."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from contactgraph.control import MPC, PlanStatus
from contactgraph.data import InvalidInputError
from contactgraph.model import ContactDynamics, shipped_model
from contactgraph.model.io import load_model
from contactgraph.policies.task_cost import TaskCost
from contactgraph_franka.envs.expert import FrankaExpert
from contactgraph_franka.envs.pickup import is_success, pickup_cost, pickup_scene
from contactgraph_franka.loop import (
    ControlLoop,
    EpisodeStart,
    LoopReport,
    Planner,
    TimedObservation,
)
from contactgraph_franka.loop.mpc_planner import MPCPlanner
from contactgraph_franka.loop.planner import PolicyPlanner
from contactgraph_franka.safety import RobotReading, SafeRobot, SafetyLimits, Stop

sys.path.insert(0, str(Path(__file__).parents[0]))
from scripted import Delayed

MAX_FORCE = 16.0
# Sweeps end beyond blocks that stand near the walls of a real arm's workspace.
WIDE = SafetyLimits(
    max_force=MAX_FORCE, workspace_low=(0.2, -0.6, 0.005), workspace_high=(0.85, 0.6, 0.6)
)
GOAL = np.zeros(3)
"""m, of the scene; each episode has its own."""


class SimulatedArm:
    """A `Robot` and a `Clock`: the task's arm in MuJoCo."""

    def __init__(self, seed: int, sensor: bool) -> None:
        from contactgraph_franka.envs.arm_model import inverse_kinematics
        from contactgraph_franka.envs.arm_world import ArmWorld
        from contactgraph_franka.envs.franka_task import FrankaTask, sample_layout

        task = FrankaTask()
        layout = sample_layout(np.random.default_rng(seed), 0)
        joints = inverse_kinematics(task._arm, layout.hand, layout.yaw)
        self.world = ArmWorld(joints, layout.blocks, layout.block_yaw, 0.001)
        self.goal = layout.goal
        self.sensor, self.cycle, self.stopped = sensor, 0, False
        self.force = np.zeros(3)

    def __call__(self) -> float:
        return 0.001 * self.cycle

    def wait_until(self, until: float) -> None:
        while self() < until - 1e-9:
            self.world.step_under(lambda part: self.force)
            self.cycle += 1

    def read(self) -> RobotReading:
        world = self.world
        contact = world.contact.astype(float) if self.sensor else None
        return RobotReading(
            world.position, world.velocity, np.full(2, self()), self(), np.ones(2), contact=contact
        )

    def send(self, force: np.ndarray, now: float) -> np.ndarray:
        self.force = force.copy()
        return self.force

    def stop(self, stop: Stop) -> None:
        self.force = -200.0 * self.world.velocity[0]

    def resume(self) -> None:
        self.force = np.zeros(3)


def control(
    planner: Planner, seed: int, delay: float = 0.0, sensor: bool = True
) -> tuple[LoopReport, SimulatedArm]:
    arm = SimulatedArm(seed, sensor)
    loop = ControlLoop(SafeRobot(arm, WIDE, arm), Delayed(planner, arm, delay), arm)
    return loop.run(4.0, arm.goal, seed), arm


def planner_of(model: ContactDynamics, max_force: float = MAX_FORCE) -> MPCPlanner:
    return MPCPlanner(model, pickup_scene(model.dt, GOAL), TaskCost(pickup_cost(), 3), max_force)


@pytest.fixture(scope="module")
def model() -> ContactDynamics:
    return load_model(shipped_model("franka")).model


@pytest.fixture(scope="module")
def mpc(model: ContactDynamics) -> MPCPlanner:
    return planner_of(model)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "delay", "sensor"), [(312, 0.03, True), (313, 0.015, False)])
def test_mpc_picks_up_through_the_loop(
    mpc: MPCPlanner, seed: int, delay: float, sensor: bool
) -> None:
    report, arm = control(mpc, seed, delay, sensor)
    assert report.completed and report.plans_failed == 0
    assert is_success(arm.world.position, arm.goal)


def test_the_expert_picks_up_through_the_loop() -> None:
    report, arm = control(PolicyPlanner(FrankaExpert(), pickup_scene(0.01, GOAL)), 304, 0.002)
    assert report.completed
    assert is_success(arm.world.position, arm.goal)


def observation(time: float, contact: float) -> TimedObservation:
    position, still, stamp = np.full((2, 3), time), np.zeros((2, 3)), np.full(2, time)
    touch = np.array([[0.0, contact], [contact, 0.0]])
    reading = RobotReading(position, still, stamp, time, np.ones(2), contact=touch)
    return TimedObservation(time, reading, np.full(3, time))


class RecordedMPC:
    """Records the arguments of `ActiveSetMPC`, and fails to plan where the contact is 1."""

    def __init__(self, mpc: MPC) -> None:
        self.config, self.steps = mpc.config, []

    def reset(self, observation: Any, nodes: Any, cost: Any) -> int:
        self.goal = observation["goal"]
        return 0

    def step(self, observed: Any, contact: Any, state: int, *rest: Any, replan: bool) -> Any:
        self.steps.append((observed["position"], contact, *rest, state, replan))
        failed = contact[0, 1] == 1.0
        outcome = PlanStatus.NOT_FINITE if failed else PlanStatus.CONVERGED
        return SimpleNamespace(outcome=outcome), state + 1


def test_skipped_observations_update_the_belief_and_one_plan_is_made(
    model: ContactDynamics, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "contactgraph_franka.loop.mpc_planner"
    monkeypatch.setattr(f"{module}.ActiveSetMPC", RecordedMPC)
    monkeypatch.setattr(f"{module}.plan_feedback", lambda *arguments: arguments)
    planner = planner_of(model)
    recorded: Any = planner._mpc
    with pytest.raises(InvalidInputError, match=r"call reset\(start\) first"):
        planner.plan([])
    planner.reset(EpisodeStart(observation(0.0, 0.0).reading, np.ones(3)))
    np.testing.assert_array_equal(recorded.goal, np.ones(3))
    given = [observation(0.01 * k, 0.5) for k in range(3)]
    assert planner.plan(given)[1:] == (model.dt, 2, 3)
    for k, (position, contact, applied, *last) in enumerate(recorded.steps):
        np.testing.assert_array_equal(position, given[k].reading.position)
        np.testing.assert_array_equal(contact, given[k].reading.contact)
        np.testing.assert_array_equal(applied, given[k].applied)
        assert last == [k, k == 2]
    assert planner.plan([observation(0.03, 1.0)]) is None
    # Every plan is within the force that the limits permit.
    limits = recorded.config.planner.limits
    np.testing.assert_allclose(np.linalg.norm(limits.upper), MAX_FORCE, rtol=1e-6)
    np.testing.assert_array_equal(limits.lower, -limits.upper)
    assert recorded.config.replan_every == recorded.config.planner.horizon


def test_invalid_arguments(model: ContactDynamics) -> None:
    with pytest.raises(InvalidInputError, match=r"max_force must be positive, found 0\.0"):
        planner_of(model, 0.0)
    cost = TaskCost(pickup_cost(), 3)
    with pytest.raises(InvalidInputError, match=r"the model is for dt 0\.01 s, but the robot has"):
        MPCPlanner(model, pickup_scene(0.02, GOAL), cost, 16.0)
