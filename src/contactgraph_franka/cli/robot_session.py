"""One run after another with an arm: loop, recording, and how each ended."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from contactgraph.data import Metadata, Trajectory
from contactgraph_franka.cli.robot_arms import Arm
from contactgraph_franka.cli.robot_dry import DryRobot, SpokenPlans
from contactgraph_franka.envs.pickup import TARGET, is_success, pickup_scene
from contactgraph_franka.loop import ControlLoop, LoopReport, PlanningProcess
from contactgraph_franka.recording import RunRecorder
from contactgraph_franka.robot import Robot, RobotReading, SafeRobot, SafetyLimits

_NODES = 2
_PERIOD = 0.001
"""s"""


@dataclass(frozen=True)
class Ended:
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
        planning: PlanningProcess,
        seconds: float,
        dry: bool = False,
    ) -> None:
        """Each run lasts for ``seconds``. ``dry``: the arm is sent nothing, and plans are said."""
        self._arm, self._seconds = arm, seconds
        robot: Robot = DryRobot(arm.robot) if dry else arm.robot
        self._loop = ControlLoop(
            SafeRobot(robot, limits, arm.clock),
            SpokenPlans(planning) if dry else planning,
            arm.clock,
            period=_PERIOD,
        )
        self._recorder = RunRecorder(seconds, _NODES, period=_PERIOD)
        self._last: RobotReading | None = None

    def run(self, goal: np.ndarray, seed: int, asked: Callable[[], bool]) -> LoopReport:
        """One run to ``goal`` [3] m; it ends gently when ``asked``."""
        self._recorder.begin()
        for each in (self._arm.seen, self._arm.assumed):
            if each is not None:
                each.begin()
        return self._loop.run(self._seconds, goal, seed, on_tick=self._tick, asked_to_stop=asked)

    @property
    def began(self) -> float:
        """s, on the arm's clock: the first state of what `recorded` gave last."""
        return self._recorder.began

    def recorded(self, goal: np.ndarray, told: Metadata, smooth: bool = True) -> Trajectory | None:
        """The last run, with what is ``told`` of it; None where no force was sent.

        Where the block was is smoothed by what was seen later, or else as it was known then.
        """
        seen = self._arm.seen
        scene = pickup_scene(_PERIOD, goal)
        ended = self.ended(goal)
        metadata = {**scene.metadata, **told, "pace": self._arm.clock.pace}
        if ended.success is not None:
            metadata["success"] = ended.success
        tracks = seen.tracks if smooth and seen is not None else None
        return self._recorder.run(replace(scene, metadata=metadata), tracks)

    def ended(self, goal: np.ndarray) -> Ended:
        """Where the last run led."""
        if self._last is None or not np.isfinite(self._last.position).all():
            return Ended(None, None)
        position = self._last.position
        distance = float(np.linalg.norm(position[TARGET] - goal))
        return Ended(is_success(position, goal), distance)

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
