"""``contactgraph robot``: the group of commands, with ``check``, ``calibrate`` and ``rehearse``."""

import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from tyro.conf import Positional, arg, subcommand

from contactgraph.cli.options import check_range
from contactgraph.cli.output import check_suffix, check_writable, write_json
from contactgraph.data import InvalidInputError
from contactgraph_franka.cli.arms import frames, open_arm
from contactgraph_franka.cli.control import ControlSimulated, Run
from contactgraph_franka.cli.options import FAKE, ArmOptions, RobotFault, check_seconds, point
from contactgraph_franka.cli.record import Record, RecordSimulated
from contactgraph_franka.loop.control_loop import measure_loop

if TYPE_CHECKING:
    from contactgraph_franka.perception import Camera, TaggedObject
    from contactgraph_franka.perception.object_pose import ObjectPose

_MIN_HZ = 500.0
_MAX_JITTER_MS = 3.0
"""Of 99 % of the cycles."""
_MIN_POSES = 6
_FRAME_TIMEOUT = 3.0
"""Wall seconds."""


@dataclass(frozen=True)
class Check:
    """Print an arm's versions, state and limits, and the timing of a control loop with it.

    The hand is held softly at its position during the measurement.
    """

    address: Positional[Annotated[str, arg(metavar="ADDR")]]
    """The arm's address, a simulated robot's, or fake."""
    seconds: float = 5.0
    """Duration of the measurement."""
    max_force: Annotated[float, arg(metavar="N")] = 16.0
    """The largest force on the hand, N."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the measurements to this file."""

    def run(self) -> None:
        """Measure and print."""
        check_writable(self.json)
        check_seconds("--seconds", self.seconds)
        block = None if self.address == FAKE else (0.5, 0.0, 0.0)
        options = ArmOptions(block=block, max_force=self.max_force)
        limits = options.limits(self.address)
        with open_arm(self.address, options) as arm:
            for name, text in arm.describe(limits):
                print(f"{name:<11}{text}")
            timing = measure_loop(arm.robot, limits, arm.clock, self.seconds)
            error = arm.last_error()
        for line in timing.lines():
            print(line)
        report = timing.report
        write_json(self.json, {"address": self.address, **timing.to_json()})
        if not report.completed:
            raise RobotFault(f"the arm stopped: {report.stop.reason.value}. {error}".strip())
        if report.rate_hz < _MIN_HZ or report.jitter_ms_p99 > _MAX_JITTER_MS:
            raise RobotFault(
                f"the loop runs at {report.rate_hz:.0f} Hz with cycles {report.jitter_ms_p99:.1f} "
                f"ms late (99 %); it needs {_MIN_HZ:.0f} Hz and {_MAX_JITTER_MS:g} ms: let this "
                "computer do nothing else, and see docs/real-arm.md about real-time priority"
            )
        print("fit to be controlled")


@dataclass(frozen=True)
class Calibrate:
    """Calibrate a camera's pose by a tag on the hand, which a person guides by hand.

    Fix a tag anywhere on the hand. Show it to the camera at each of the requested poses, turned by
    20 degrees and more about two axes between poses. The arm does not move by itself.
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
    """Number of poses."""

    def run(self) -> None:
        """Collect poses, solve and write."""
        from contactgraph_franka.perception import (
            CameraCalibration,
            single_tag,
            write_calibration,
        )
        from contactgraph_franka.sim.blocks import tagged_objects

        check_suffix("--out", self.out, ".json")
        check_writable(self.out)
        check_range("--poses", self.poses, _MIN_POSES, 200)
        marker = single_tag(self.tag, self.tag_size)
        blocks = tagged_objects(1)
        if any(self.tag in tagged.by_id for tagged in blocks.values()):
            raise InvalidInputError(f"--tag {self.tag} is one of the block's; take another")
        if self.address == FAKE:
            raise InvalidInputError("the fake arm has no camera to calibrate")
        from contactgraph_franka.driver.franka_robot import FrankaRobot
        from contactgraph_franka.perception.hand_eye import calibrate
        from contactgraph_franka.perception.realsense import RealSenseCamera

        hand_poses: list[np.ndarray] = []
        marker_poses: list[ObjectPose] = []
        with closing(RealSenseCamera()) as camera, FrankaRobot(self.address) as robot:
            while len(hand_poses) < self.poses:
                pose = f"pose {len(hand_poses) + 1} of {self.poses}"
                input(f"{pose}: guide the hand there, hold it still, then Enter ")
                marker_pose = _marker_pose(camera, marker)
                if marker_pose is None:
                    print(f"the camera does not see tag {self.tag}: turn it towards the camera")
                    continue
                hand_poses.append(robot.hand_pose())
                marker_poses.append(marker_pose)
        solved = calibrate(np.stack(hand_poses), marker_poses, marker, camera.intrinsics)
        calibration = CameraCalibration(
            camera.intrinsics, solved.camera_pose, blocks, residuals=solved.residuals
        )
        write_calibration(self.out, calibration)
        error = solved.residuals
        at = point(solved.camera_pose[:3, 3], 3)
        print(f"{self.out}: the camera is at {at} m from the arm's base")
        print(
            f"off by {error.pixel:.2f} px; {1e3 * error.left_out:.1f} mm at poses left out, "
            f"{1e3 * error.left_out_worst:.1f} mm at worst: a pickup needs 5"
        )


def _marker_pose(camera: "Camera", marker: "TaggedObject") -> "ObjectPose | None":
    """The marker's pose in the next frame; None where the frame does not show it."""
    from contactgraph_franka.perception.detector import estimate_pose
    from contactgraph_franka.perception.tags import TagDetector

    detector = TagDetector([tuple(marker.by_id)])
    camera.read()  # discards a frame exposed while the hand still moved
    for frame in frames(camera, _FRAME_TIMEOUT):
        return estimate_pose(frame, detector.detect(frame.image), marker, camera.intrinsics)
    return None


@dataclass(frozen=True)
class Simulate:
    """Simulate an arm behind the real one's protocol, with table and tagged block, until Ctrl-C.

    Its address takes the same commands as a real arm's.
    """

    pace: float = 4.0
    """Wall seconds to a simulated one; 1 is real time, and needs four cores."""
    camera: bool = False
    """Add a camera that sees the block, for --camera rendered."""
    block_mass: Annotated[float, arg(metavar="KG")] = 0.83
    """Mass of the block."""
    address: Annotated[str | None, arg(metavar="ADDR")] = None
    """A loopback address; by default the first free one from 127.0.0.1 on."""

    def run(self) -> None:
        """Start the simulation, print its address, and wait."""
        from contactgraph_franka.sim.camera import CameraSettings
        from contactgraph_franka.sim.simulated_robot import ADDRESSES, RobotSimulator

        simulator = RobotSimulator(
            pace=self.pace,
            camera=CameraSettings() if self.camera else None,
            mass=self.block_mass,
            addresses=ADDRESSES if self.address is None else (self.address,),
        )
        with simulator as robot:
            print(f"an arm is simulated at {robot.address}, {self.pace:g} times slower than real")
            block = "--camera rendered" if self.camera else "--block 0.5 -0.15 0.05"
            print("in another terminal:")
            print(f"  contactgraph robot check {robot.address}")
            print(f"  contactgraph robot run franka {robot.address} --goal 0.45 0.1 0.3 {block}")
            print("Ctrl-C ends it")
            try:
                while True:
                    simulator.check()
                    time.sleep(0.5)
            except KeyboardInterrupt:
                print("ended")


@dataclass(frozen=True)
class Robot:
    """Check, control, record or simulate an arm."""

    action: (
        Annotated[Check, subcommand("check")]
        | Annotated[Run, subcommand("run")]
        | Annotated[Record, subcommand("record")]
        | Annotated[Calibrate, subcommand("calibrate")]
        | Annotated[Simulate, subcommand("rehearse")]
        | Annotated[RecordSimulated, subcommand("rehearse-record")]
        | Annotated[ControlSimulated, subcommand("rehearse-control")]
    )

    def run(self) -> None:
        """Run the chosen command."""
        self.action.run()
