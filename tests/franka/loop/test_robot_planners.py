"""Planners beside a robot's loop, on the arm in MuJoCo: time is simulated, plans come late."""

import sys
from pathlib import Path

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.evaluate.mpc_policy import TaskCost
from contactgraph.model import shipped_model
from contactgraph.model.io import load_model
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
NOWHERE = np.zeros(3)


class SimulatedArm:
    """A `Robot` and a `Clock`: the task's arm, a tick at a time."""

    def __init__(self, seed: int, sensor: bool) -> None:
        from contactgraph_franka.envs.arm_world import ArmWorld
        from contactgraph_franka.envs.franka_task import (
            FrankaTask,
            inverse_kinematics,
            sample_layout,
        )

        task = FrankaTask()
        layout = sample_layout(np.random.default_rng(seed), 0)
        joints = inverse_kinematics(task._arm, layout.hand, layout.yaw)
        self.world = ArmWorld(joints, layout.blocks, layout.block_yaw, 0.001)
        self.goal = layout.goal
        self.sensor, self.tick, self.stopped = sensor, 0, False
        self.force = np.zeros(3)

    def __call__(self) -> float:
        return 0.001 * self.tick

    def wait_until(self, moment: float) -> None:
        while self() < moment - 1e-9:
            self.world.step_under(lambda part: self.force)
            self.tick += 1

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


def driven(
    planner: Planner, seed: int, delay: float = 0.0, sensor: bool = True
) -> tuple[LoopReport, SimulatedArm]:
    arm = SimulatedArm(seed, sensor)
    loop = ControlLoop(SafeRobot(arm, WIDE, arm), Delayed(planner, arm, delay), arm)
    return loop.run(4.0, arm.goal, seed), arm


@pytest.fixture(scope="module")
def mpc() -> MPCPlanner:
    model = load_model(shipped_model("franka")).model
    scene, cost = pickup_scene(model.dt, NOWHERE), TaskCost.of(pickup_cost(), 3)
    return MPCPlanner(model, scene, cost, MAX_FORCE)


@pytest.mark.parametrize(
    ("seed", "delay", "sensor"), [(311, 0.0, True), (312, 0.03, True), (313, 0.015, False)]
)
def test_mpc_picks_up_through_the_loop(
    mpc: MPCPlanner, seed: int, delay: float, sensor: bool
) -> None:
    report, arm = driven(mpc, seed, delay, sensor)
    assert report.completed and report.plans_failed == 0
    assert is_success(arm.world.position, arm.goal)


def test_the_expert_picks_up_through_the_loop() -> None:
    scene = pickup_scene(0.01, NOWHERE)
    report, arm = driven(PolicyPlanner(FrankaExpert(), scene), 304, 0.002)
    assert report.completed
    assert is_success(arm.world.position, arm.goal)


def test_moments_that_were_missed_are_followed_and_one_plan_is_made(mpc: MPCPlanner) -> None:
    def moments(planner: MPCPlanner, arm: SimulatedArm, count: int) -> list[TimedObservation]:
        found = []
        for _ in range(count):
            found.append(TimedObservation(arm(), arm.read(), arm.force))
            arm.wait_until(arm() + 0.01)
        return found

    arm = SimulatedArm(305, True)
    mpc.reset(EpisodeStart(arm.read(), arm.goal))
    told = moments(mpc, arm, 4)
    law = mpc.plan(told)
    assert law is not None and law.duration == pytest.approx(0.5)
    np.testing.assert_allclose(law.states[0, :, 0], told[-1].reading.position, atol=1e-6)


def test_plans_ask_for_no_more_than_the_limits_let_pass(mpc: MPCPlanner) -> None:
    arm = SimulatedArm(306, True)
    far = RobotReading(
        arm.world.position + np.array([[0.0, 0.0, 0.0], [5.0, 5.0, 5.0]]),
        np.zeros((2, 3)),
        np.zeros(2),
        0.0,
        np.ones(2),
    )
    mpc.reset(EpisodeStart(far, arm.goal))
    law = mpc.plan([TimedObservation(0.0, far, np.zeros(3))])
    assert law is not None
    longest = np.linalg.norm(law.controls, axis=1).max()
    assert 0.99 * MAX_FORCE < longest <= MAX_FORCE * (1.0 + 1e-6)


def test_a_planner_for_no_force(mpc: MPCPlanner) -> None:
    model = load_model(shipped_model("franka")).model
    cost = TaskCost.of(pickup_cost(), 3)
    with pytest.raises(InvalidInputError, match=r"max_force must be positive, found 0\.0"):
        MPCPlanner(model, pickup_scene(model.dt, NOWHERE), cost, 0.0)
    with pytest.raises(InvalidInputError, match=r"the model is for dt 0\.01 s, but the robot has"):
        MPCPlanner(model, pickup_scene(0.02, NOWHERE), cost, 16.0)
