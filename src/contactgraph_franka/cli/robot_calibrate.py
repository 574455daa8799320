"""``contactgraph robot calibrate``: where the camera stands, as seen from the arm's base."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

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
        from contactgraph.cli.output import check_suffix, check_writable, say
        from contactgraph.data import InvalidInputError
        from contactgraph_franka.cli.robot_options import FAKE
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
                        say(f"the camera does not see tag {self.tag}: turn it towards the camera")
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
        say(f"{self.out}: the camera is at ({where}) m from the arm's base")
        say(
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
