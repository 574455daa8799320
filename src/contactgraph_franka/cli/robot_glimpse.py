"""A look through a camera, before anything moves."""

import time
from collections.abc import Callable

import numpy as np

from contactgraph_franka.cli.robot_fault import RobotFault
from contactgraph_franka.perception import Camera, CameraCalibration
from contactgraph_franka.perception.detector import ObjectDetector, PoseEstimate

_LOOK_S = 15.0
"""Wall seconds: rehearsed cameras are slow."""


def glimpsed(
    open_camera: Callable[[], Camera], calibration: CameraCalibration, name: str
) -> PoseEstimate:
    """The object of this name, in the first frame that shows it.

    Raises `RobotFault` where none does.
    """
    camera = open_camera()
    try:
        sight, until = ObjectDetector(calibration), time.monotonic() + _LOOK_S
        while time.monotonic() < until:
            frame = camera.read()
            seen = {} if frame is None else sight.detect(frame)
            if name in seen:
                return seen[name]
            time.sleep(0.01)
    finally:
        camera.close()
    raise RobotFault(
        f"the camera does not see the {name}: is it in the picture, lit, its tags towards the "
        "camera, and the calibration this camera's?"
    )


def glimpsed_yaw(
    open_camera: Callable[[], Camera], calibration: CameraCalibration, name: str
) -> float:
    """rad: how the object is turned about the vertical. Raises as `glimpsed`."""
    turn = glimpsed(open_camera, calibration, name).pose[:3, :3]
    return float(np.arctan2(turn[1, 0], turn[0, 0]))
