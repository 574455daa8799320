"""Episodes with an arm: control loop, recording, outcome, and their reproducible layouts."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from contactgraph.data import Metadata, Trajectory
from contactgraph_franka.cli.arms import Arm, open_arm
from contactgraph_franka.cli.options import NO_BLOCK, ArmOptions, RobotFault, point
from contactgraph_franka.envs.pickup import (
    TARGET,
    ArmLayout,
    is_success,
    pickup_scene,
    sample_layout,
    sweep_fits,
)
from contactgraph_franka.loop import (
    AsyncPlanner,
    ControlLoop,
    LoopReport,
    PlanFeedback,
    PlanResult,
)
from contactgraph_franka.recording import TrajectoryRecorder
from contactgraph_franka.safety import Robot, RobotReading, SafeRobot, SafetyLimits, Stop

if TYPE_CHECKING:
    from contactgraph_franka.sim.simulated_robot import SimulatedRobot

_COUNT_DOWN = 3
"""s, for a person to object."""
_STEADY = 0.5
"""s for which it must be tracked without a break: longer than a tracker keeps a lost object."""
_BLOCK_TIMEOUT = 5.0
"""s for a camera to detect the block."""
_NODES = 2
_PERIOD = 0.001
"""s"""
_PRINT_INTERVAL = 0.5
"""s between printed plans."""
_SETTLING = 0.5
"""s in which a placed block comes to rest and its track forgets the previous position."""


class ReadOnlyRobot:
    """A `Robot` that is read, and receives no force."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    @property
    def ended(self) -> Stop | None:
        """See `Robot`."""
        return self._robot.ended

    def read(self) -> RobotReading | None:
        """See `Robot`."""
        return self._robot.read()

    def send(self, force: np.ndarray, now: float) -> np.ndarray:
        """Sends nothing, and returns zero."""
        return np.zeros_like(force)

    def stop(self, stop: Stop) -> None:
        """Does nothing, since the robot is at rest."""

    def resume(self) -> None:
        """Does nothing: the robot stays out of control."""


@dataclass(frozen=True)
class EpisodeOutcome:
    """Final state of an episode; the names are those of the commands' JSON."""

    success: bool | None
    """Whether the hand holds the block at the goal; None where nothing was read."""
    distance_m: float | None
    """From block to goal."""

    def __str__(self) -> str:
        if self.distance_m is None:
            return "nothing was read"
        result = "yes: the block is held" if self.success else "no: the block is not"
        return f"success    {result} at the goal, {100 * self.distance_m:.1f} cm from it"


class Session:
    """Runs one episode after another with an arm, and records each."""

    def __init__(
        self,
        arm: Arm,
        limits: SafetyLimits,
        planner: AsyncPlanner,
        seconds: float,
        dry: bool = False,
    ) -> None:
        """Each episode lasts ``seconds``. ``dry``: no force is sent, and plans are printed."""
        self._arm, self._seconds, self._dry = arm, seconds, dry
        robot: Robot = ReadOnlyRobot(arm.robot) if dry else arm.robot
        self._loop = ControlLoop(
            SafeRobot(robot, limits, arm.clock),
            planner,
            arm.clock,
            period=_PERIOD,
        )
        self._recorder = TrajectoryRecorder(seconds, _NODES, period=_PERIOD)
        self._last: RobotReading | None = None

    def run(
        self, goal: np.ndarray, seed: int, stop_requested: Callable[[], bool] = lambda: False
    ) -> LoopReport:
        """Runs one episode to ``goal`` [3] m; ``stop_requested`` ends it gently."""
        self._recorder.reset()
        self._next_print = 0.0
        if self._arm.objects is not None:
            self._arm.objects.begin()
        return self._loop.run(
            self._seconds,
            goal,
            seed,
            on_cycle=self._record,
            on_plan=self._print_plan if self._dry else None,
            stop_requested=stop_requested,
        )

    @property
    def began(self) -> float:
        """s, on the arm's clock: the first state of the last `trajectory`."""
        return self._recorder.began

    def trajectory(
        self, goal: np.ndarray, metadata: Metadata, smooth: bool = True
    ) -> Trajectory | None:
        """The last episode with ``metadata``; None where no force was sent.

        With ``smooth``, later frames of the camera correct the block's states; else they are those
        known at the time.
        """
        objects = self._arm.objects
        scene = pickup_scene(_PERIOD, goal)
        outcome = self.outcome(goal)
        metadata = {**scene.metadata, **metadata, "pace": self._arm.clock.pace}
        if outcome.success is not None:
            metadata["success"] = outcome.success
        tracks = objects.tracks if smooth and objects is not None else None
        return self._recorder.trajectory(replace(scene, metadata=metadata), tracks)

    def outcome(self, goal: np.ndarray) -> EpisodeOutcome:
        """The outcome of the last episode, with ``goal`` [3] m."""
        if self._last is None or not np.isfinite(self._last.position).all():
            return EpisodeOutcome(None, None)
        position = self._last.position
        distance = float(np.linalg.norm(position[TARGET] - goal))
        return EpisodeOutcome(is_success(position, goal), distance)

    def _print_plan(self, elapsed: float, result: PlanResult) -> None:
        if elapsed < self._next_print or not isinstance(result.policy, PlanFeedback):
            return
        self._next_print = elapsed + _PRINT_INTERVAL
        hand, block = result.policy.states[-1, :2, 0]
        force = point(result.policy.controls[0], 1)
        print(
            f"at {elapsed:4.1f} s: first force {force} N; in {result.policy.duration:g} s the hand "
            f"at {point(hand)} m, the block at {point(block)} m"
        )

    def _record(self, now: float, reading: RobotReading | None, sent: np.ndarray | None) -> None:
        self._recorder(now, reading, sent)
        self._last = reading or self._last


def block_position(arm: Arm) -> np.ndarray:
    """[3] m: the present position of the block, which must be tracked."""
    while True:
        reading = arm.robot.read()
        if reading is not None:
            return reading.position[TARGET]
        arm.clock.wait_until(arm.clock() + _PERIOD)


@dataclass(frozen=True)
class SimulatedSetup:
    """A simulated arm with its ground truth."""

    arm: Arm
    simulation: "SimulatedRobot"
    limits: SafetyLimits

    def arrange(self, layout: ArmLayout) -> None:
        """Puts hand and block to the start of an episode; the camera sees the block."""
        self.arm.move_to(layout.hand, layout.yaw)
        self.arm.place_block(layout)
        self.arm.clock.wait_until(self.arm.clock() + _SETTLING)
        wait_for_block(self.arm)


@contextmanager
def simulated_setup(pace: float) -> Iterator[SimulatedSetup]:
    """Starts a simulated robot at a free address, ``pace`` times slower than real, and ends it."""
    from contactgraph_franka.sim.camera import CameraSettings
    from contactgraph_franka.sim.simulated_robot import RobotSimulator

    options = ArmOptions(camera="rendered")
    with (
        RobotSimulator(pace=pace, camera=CameraSettings()) as simulation,
        open_arm(simulation.address, options) as arm,
    ):
        yield SimulatedSetup(arm, simulation, options.limits(simulation.address))


def episode_layout(seed: int, number: int, limits: SafetyLimits) -> ArmLayout:
    """Start, block and goal of an episode: the same for the same ``seed`` and ``number``."""
    random = np.random.default_rng([seed, number])
    low, high = np.array(limits.workspace_low), np.array(limits.workspace_high)
    while True:
        layout = sample_layout(random, 0)
        if sweep_fits(layout.hand, layout.blocks[0], low, high):
            return layout


def episode_seed(seed: int, number: int) -> int:
    """Seed of an episode's policy."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def count_down(arm: Arm, motion: str) -> None:
    """Prints the coming ``motion``; before one of a real arm, leaves time to prevent it."""
    print(f"{arm.name}: {motion}")
    if not arm.real:
        return
    print("Keep a hand on its stop button, and everybody away from it. Ctrl-C stops it gently.")
    for left in range(_COUNT_DOWN, 0, -1):
        print(f"in {left} s ...")
        time.sleep(1.0)


def wait_for_block(arm: Arm) -> None:
    """Returns when the block is tracked steadily; raises `RobotFault` where it is not."""
    since = began = arm.clock()
    while arm.objects is not None:
        now = arm.clock()
        if not all(each.tracked for each in arm.objects.estimates(now)):
            since = now
        if now - since > _STEADY:
            return
        if now - began > _BLOCK_TIMEOUT:
            raise RobotFault(f"the camera does not see the block: {NO_BLOCK}")
        time.sleep(0.02)
