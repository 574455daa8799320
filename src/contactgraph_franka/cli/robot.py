"""``contactgraph robot check``: whether an arm is fit to be controlled."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg, subcommand

from contactgraph_franka.cli.control import RehearseControl, Run
from contactgraph_franka.cli.options import ArmOptions
from contactgraph_franka.cli.record import Record, RehearseRecord

_LEAST_HZ = 500.0
_MOST_LATE_MS = 3.0
"""99 % of ticks."""


@dataclass(frozen=True)
class Check:
    """Say what arm it is, its state and limits, and how well a loop with it keeps time.

    The hand is held where it is, softly, while that is measured.
    """

    address: Positional[Annotated[str, arg(metavar="ADDR")]]
    """The arm's address, one in a rehearsal, or fake."""
    seconds: float = 5.0
    """For how long the loop is measured."""
    max_force: Annotated[float, arg(metavar="N")] = 16.0
    """The longest force on the hand, N."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the measurements to this file."""

    def run(self) -> None:
        """Look, measure and say."""
        from contactgraph.cli.output import check_writable, write_json
        from contactgraph_franka.cli.arms import open_arm
        from contactgraph_franka.cli.options import FAKE, RobotFault, check_seconds
        from contactgraph_franka.loop.control_loop import measure_loop

        check_writable(self.json)
        check_seconds("--seconds", self.seconds)
        nowhere = None if self.address == FAKE else (0.5, 0.0, 0.0)
        options = ArmOptions(block=nowhere, max_force=self.max_force)
        limits = options.limits(self.address)
        with open_arm(self.address, options) as arm:
            for name, words in arm.describe(limits):
                print(f"{name:<11}{words}")
            timing = measure_loop(arm.robot, limits, arm.clock, self.seconds)
            said = arm.said()
        for line in timing.lines():
            print(line)
        report = timing.report
        write_json(
            self.json,
            {
                "address": self.address,
                **report.to_json(),
                "states_hz": timing.states_hz,
                "state_gap_ms_p50": timing.state_gap_ms_p50,
                "state_gap_ms_p99": timing.state_gap_ms_p99,
                "state_gap_ms_worst": timing.state_gap_ms_worst,
            },
        )
        if not report.completed:
            raise RobotFault(f"the arm stopped: {report.stop.reason.value}. {said}".strip())
        if report.rate_hz < _LEAST_HZ or report.jitter_ms_p99 > _MOST_LATE_MS:
            raise RobotFault(
                f"the loop runs at {report.rate_hz:.0f} Hz with ticks {report.jitter_ms_p99:.1f} "
                f"ms late (99 %); it needs {_LEAST_HZ:.0f} Hz and {_MOST_LATE_MS:g} ms: let this "
                "computer do nothing else, and see docs/real-arm.md about real-time priority"
            )
        print("fit to be controlled")


if TYPE_CHECKING:
    from contactgraph_franka.perception import Camera, TaggedObject
    from contactgraph_franka.perception.object_pose import ObjectPose

_FEWEST = 6
_FRAME_S = 3.0
"""Wall seconds to wait for a frame."""


@dataclass(frozen=True)
class Calibrate:
    """Find where a camera stands, from a tag on the hand, which a person guides about by hand.

    Fix a tag anywhere on the hand. At each of the places that are asked for, let the camera see it,
    turned by 20 degrees and more about two axes from place to place. The arm moves nothing itself.
    """

    address: Positional[Annotated[str, arg(metavar="ADDR")]]
    """The arm's address."""
    out: Annotated[Path, arg(metavar="FILE")]
    """The file to write (.json)."""
    tag: int = 100
    """The id of the tag36h11 on the hand; 0 to 17 are those of blocks."""
    tag_size: Annotated[float, arg(metavar="M")] = 0.04
    """The side of its black square, m."""
    poses: int = 20
    """At how many places it is looked at."""

    def run(self) -> None:
        """Ask, look, solve and write."""
        from datetime import UTC, datetime

        import numpy as np

        from contactgraph.cli.options import check_range
        from contactgraph.cli.output import check_suffix, check_writable
        from contactgraph.data import InvalidInputError
        from contactgraph_franka.cli.options import FAKE
        from contactgraph_franka.perception import (
            CameraCalibration,
            single_tag,
            write_calibration,
        )
        from contactgraph_franka.sim.blocks import block_names, scene_blocks

        check_suffix("--out", self.out, ".json")
        check_writable(self.out)
        check_range("--poses", self.poses, _FEWEST, 200)
        marker = single_tag(self.tag, self.tag_size)
        blocks = dict(zip(block_names(1), (each.tagged for each in scene_blocks(1)), strict=True))
        if any(self.tag in tagged.by_id for tagged in blocks.values()):
            raise InvalidInputError(f"--tag {self.tag} is one of the block's; take another")
        if self.address == FAKE:
            raise InvalidInputError("the fake arm has no camera to calibrate")
        from contactgraph_franka.driver.franka_robot import FrankaRobot
        from contactgraph_franka.perception.hand_eye import calibrate
        from contactgraph_franka.perception.realsense import RealSenseCamera

        hands: list[np.ndarray] = []
        sightings: list[ObjectPose] = []
        camera = RealSenseCamera()
        try:
            with FrankaRobot(self.address) as robot:
                while len(hands) < self.poses:
                    place = f"place {len(hands) + 1} of {self.poses}"
                    input(f"{place}: guide the hand there, hold it still, then Enter ")
                    found = _seen(camera, marker)
                    if found is None:
                        print(f"the camera does not see tag {self.tag}: turn it towards the camera")
                        continue
                    hands.append(robot.hand_pose())
                    sightings.append(found)
            solved = calibrate(np.stack(hands), sightings, marker, camera.intrinsics)
            made = datetime.now(UTC).isoformat(timespec="seconds")
            calibration = CameraCalibration(
                camera.intrinsics, solved.camera_pose, blocks, made, solved.residuals
            )
        finally:
            camera.close()
        write_calibration(self.out, calibration)
        told = solved.residuals
        where = ", ".join(f"{number:.3f}" for number in solved.camera_pose[:3, 3])
        print(f"{self.out}: the camera is at ({where}) m from the arm's base")
        print(
            f"off by {told.pixel:.2f} px; {1e3 * told.left_out:.1f} mm at places left out, "
            f"{1e3 * told.left_out_worst:.1f} mm at worst: a pickup needs 5"
        )


def _seen(camera: "Camera", marker: "TaggedObject") -> "ObjectPose | None":
    """The marker in the next frame; None where that does not show it."""
    import time

    from contactgraph_franka.perception.detector import estimate_pose
    from contactgraph_franka.perception.tags import TagDetector

    detector = TagDetector([tuple(marker.by_id)])
    camera.read()  # what was exposed while the hand still moved
    until = time.monotonic() + _FRAME_S
    while time.monotonic() < until:
        frame = camera.read()
        if frame is not None:
            return estimate_pose(frame, detector.detect(frame.image), marker, camera.intrinsics)
        time.sleep(0.01)
    return None


@dataclass(frozen=True)
class Rehearse:
    """Simulate an arm behind the real one's protocol, with table and tagged block, until Ctrl-C.

    What is sent to its address is what a real arm would be sent.
    """

    pace: float = 4.0
    """Wall seconds to a simulated one; 1 is real time, and needs four cores."""
    camera: bool = False
    """With a camera that sees the block: --camera rendered uses it."""
    block_mass: Annotated[float, arg(metavar="KG")] = 0.83
    """The block's."""
    address: Annotated[str | None, arg(metavar="ADDR")] = None
    """A loopback address; the first free one from 127.0.0.1 on, if not given."""

    def run(self) -> None:
        """EpisodeStart, say where, and wait."""
        from contactgraph_franka.sim.camera import CameraSettings
        from contactgraph_franka.sim.simulated_robot import ADDRESSES, RobotSimulator

        rehearsal = RobotSimulator(
            pace=self.pace,
            camera=CameraSettings() if self.camera else None,
            mass=self.block_mass,
            addresses=ADDRESSES if self.address is None else (self.address,),
        )
        with rehearsal as running:
            print(f"an arm is simulated at {running.address}, {self.pace:g} times slower than real")
            how = "--camera rendered" if self.camera else "--block 0.5 -0.15 0.05"
            print("in another terminal:")
            print(f"  contactgraph robot check {running.address}")
            print(f"  contactgraph robot run franka {running.address} --goal 0.45 0.1 0.3 {how}")
            print("Ctrl-C ends it")
            try:
                while True:
                    rehearsal.check()
                    time.sleep(0.5)
            except KeyboardInterrupt:
                print("ended")


ACTIONS = ("check", "run", "record", "calibrate", "rehearse", "rehearse-record", "rehearse-control")


@dataclass(frozen=True)
class Robot:
    """Check, control, record or rehearse an arm."""

    action: (
        Annotated[Check, subcommand("check")]
        | Annotated[Run, subcommand("run")]
        | Annotated[Record, subcommand("record")]
        | Annotated[Calibrate, subcommand("calibrate")]
        | Annotated[Rehearse, subcommand("rehearse")]
        | Annotated[RehearseRecord, subcommand("rehearse-record")]
        | Annotated[RehearseControl, subcommand("rehearse-control")]
    )

    def run(self) -> None:
        """Do it."""
        self.action.run()
