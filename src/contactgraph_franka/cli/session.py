"""A run of which the arm notices nothing."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from contactgraph.data import Metadata, Trajectory
from contactgraph_franka.cli.arms import Arm
from contactgraph_franka.envs.pickup import TARGET, is_success, pickup_scene
from contactgraph_franka.loop import (
    AsyncPlanner,
    ControlLoop,
    EpisodeStart,
    FeedbackLaw,
    LoopReport,
    PlannerProcess,
    PlanResult,
    TimedObservation,
)
from contactgraph_franka.recording import TrajectoryRecorder
from contactgraph_franka.safety import Robot, RobotReading, SafeRobot, SafetyLimits, Stop

_EVERY = 0.5
"""s between plans that are said."""


class ReadOnlyRobot:
    """A `Robot` that is read, and sent nothing: every force that is asked for is none."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    @property
    def ended(self) -> Stop | None:
        """As the robot tells."""
        return self._robot.ended

    def read(self) -> RobotReading | None:
        """As the robot tells."""
        return self._robot.read()

    def send(self, force: np.ndarray, now: float) -> np.ndarray:
        """Nothing."""
        return np.zeros_like(force)

    def stop(self, stop: Stop) -> None:
        """It rests."""

    def resume(self) -> None:
        """It stays out of control."""


class PrintedPlans:
    """A `AsyncPlanner` that says a plan now and then."""

    def __init__(self, planning: AsyncPlanner) -> None:
        self._planning = planning
        self.interval = planning.interval

    def reset(self, start: EpisodeStart) -> None:
        """See `AsyncPlanner`."""
        self._planning.reset(start)
        self._began: float | None = None
        self._due = 0.0

    def submit(self, moment: TimedObservation) -> None:
        """See `AsyncPlanner`."""
        if self._began is None:
            self._began = self._due = moment.time
        self._planning.submit(moment)

    def poll(self) -> PlanResult | None:
        """See `AsyncPlanner`."""
        planned = self._planning.poll()
        if planned is None or self._began is None or planned.observed_at < self._due:
            return planned
        self._due = planned.observed_at + _EVERY
        if isinstance(planned.policy, FeedbackLaw):
            hand, block = planned.policy.states[-1, :2, 0]
            push = _numbers(1, planned.policy.controls[0])
            print(
                f"at {planned.observed_at - self._began:4.1f} s: first push {push} N; "
                f"in {planned.policy.duration:g} s the hand at {_numbers(2, hand)} m, "
                f"the block at {_numbers(2, block)} m"
            )
        return planned


def _numbers(digits: int, values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.{digits}f}" for value in values) + ")"


_NODES = 2
_PERIOD = 0.001
"""s"""


@dataclass(frozen=True)
class EpisodeOutcome:
    """Where a run has led."""

    success: bool | None
    """Whether the hand holds the block at the goal; None where nothing was read."""
    distance: float | None
    """m, from block to goal."""

    def to_json(self) -> dict[str, float | bool | None]:
        """Both by name."""
        return {"success": self.success, "distance_m": self.distance}

    @property
    def words(self) -> str:
        """The same for people."""
        if self.distance is None:
            return "nothing was read"
        how = "held at the goal" if self.success else "not at the goal"
        return f"success    {'yes' if self.success else 'no'}: the block is {how}, " + (
            f"{100 * self.distance:.1f} cm from it"
        )


class Session:
    """Runs an arm's loop, and keeps what it read and sent."""

    def __init__(
        self,
        arm: Arm,
        limits: SafetyLimits,
        planning: PlannerProcess,
        seconds: float,
        dry: bool = False,
    ) -> None:
        """Each run lasts for ``seconds``. ``dry``: the arm is sent nothing, and plans are said."""
        self._arm, self._seconds = arm, seconds
        robot: Robot = ReadOnlyRobot(arm.robot) if dry else arm.robot
        self._loop = ControlLoop(
            SafeRobot(robot, limits, arm.clock),
            PrintedPlans(planning) if dry else planning,
            arm.clock,
            period=_PERIOD,
        )
        self._recorder = TrajectoryRecorder(seconds, _NODES, period=_PERIOD)
        self._last: RobotReading | None = None

    def run(self, goal: np.ndarray, seed: int, asked: Callable[[], bool]) -> LoopReport:
        """One run to ``goal`` [3] m; it ends gently when ``asked``."""
        self._recorder.begin()
        for each in (self._arm.seen, self._arm.assumed):
            if each is not None:
                each.begin()
        return self._loop.run(self._seconds, goal, seed, on_cycle=self._tick, stop_requested=asked)

    @property
    def began(self) -> float:
        """s, on the arm's clock: the first state of what `recorded` gave last."""
        return self._recorder.began

    def recorded(self, goal: np.ndarray, told: Metadata, smooth: bool = True) -> Trajectory | None:
        """The last run, with what is ``told`` of it; None where no force was sent.

        Where the block was is smooth_track by what was seen later, or else as it was known then.
        """
        seen = self._arm.seen
        scene = pickup_scene(_PERIOD, goal)
        ended = self.ended(goal)
        metadata = {**scene.metadata, **told, "pace": self._arm.clock.pace}
        if ended.success is not None:
            metadata["success"] = ended.success
        tracks = seen.tracks if smooth and seen is not None else None
        return self._recorder.run(replace(scene, metadata=metadata), tracks)

    def ended(self, goal: np.ndarray) -> EpisodeOutcome:
        """Where the last run led."""
        if self._last is None or not np.isfinite(self._last.position).all():
            return EpisodeOutcome(None, None)
        position = self._last.position
        distance = float(np.linalg.norm(position[TARGET] - goal))
        return EpisodeOutcome(is_success(position, goal), distance)

    def _tick(self, now: float, reading: RobotReading | None, sent: np.ndarray | None) -> None:
        self._recorder(now, reading, sent)
        self._last = reading or self._last


def seen_block(arm: Arm) -> np.ndarray:
    """[3] m: where the block is now, as far as anybody knows. It must be tracked."""
    while True:
        reading = arm.robot.read()
        if reading is not None:
            return reading.position[TARGET]
        arm.clock.wait_until(arm.clock() + _PERIOD)


if TYPE_CHECKING:
    from contactgraph_franka.cli.arms import Arm
    from contactgraph_franka.cli.options import ArmOptions
    from contactgraph_franka.envs.pickup import ArmLayout
    from contactgraph_franka.safety import SafetyLimits
    from contactgraph_franka.sim.simulated_robot import SimulatedRobot


@dataclass(frozen=True)
class SimulatedSetup:
    """An arm, and what nobody knows of a real one."""

    arm: "Arm"
    rehearsal: "SimulatedRobot"
    limits: "SafetyLimits"

    def arrange(self, layout: "ArmLayout") -> None:
        """Hand and block to where a run begins; the camera sees the block."""
        from contactgraph_franka.cli.options import wait_for_block

        self.arm.move_to(layout.hand, layout.yaw)
        self.arm.arrange(layout)
        # Its track must forget where it stood before, and the block come to rest.
        self.arm.clock.wait_until(self.arm.clock() + 0.5)
        wait_for_block(self.arm)


@contextmanager
def simulated_setup(pace: float, options: "ArmOptions | None" = None) -> Iterator[SimulatedSetup]:
    """Starts a rehearsal at a free address, ``pace`` times slower than real, and ends it."""
    from contactgraph_franka.cli.arms import open_arm
    from contactgraph_franka.cli.options import ArmOptions
    from contactgraph_franka.sim.camera import CameraSettings
    from contactgraph_franka.sim.simulated_robot import RobotSimulator

    chosen = ArmOptions(camera="rendered") if options is None else options
    with (
        RobotSimulator(pace=pace, camera=CameraSettings()) as rehearsal,
        open_arm(rehearsal.address, chosen) as arm,
    ):
        yield SimulatedSetup(arm, rehearsal, chosen.limits(rehearsal.address))


def episode_layout(seed: int, number: int, limits: "SafetyLimits") -> "ArmLayout":
    """EpisodeStart, block and goal of a run: the same for the same ``seed`` and ``number``."""
    import numpy as np

    from contactgraph_franka.envs.pickup import sample_layout, sweep_fits

    random = np.random.default_rng([seed, number])
    low, high = np.array(limits.workspace_low), np.array(limits.workspace_high)
    while True:
        layout = sample_layout(random, 0)
        if sweep_fits(layout.hand, layout.blocks[0], low, high):
            return layout


def episode_seed(seed: int, number: int) -> int:
    """Of whatever else is random about a run."""
    import numpy as np

    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
