"""Positions and velocities of tagged objects from camera frames.

Only `tags`, `detector` and `perception` import pyapriltags, and only `realsense` pyrealsense2.
"""

from contactgraph_franka.perception.calibration import CalibrationResiduals as CalibrationResiduals
from contactgraph_franka.perception.calibration import CameraCalibration as CameraCalibration
from contactgraph_franka.perception.calibration import Tag as Tag
from contactgraph_franka.perception.calibration import TaggedObject as TaggedObject
from contactgraph_franka.perception.calibration import read_calibration as read_calibration
from contactgraph_franka.perception.calibration import single_tag as single_tag
from contactgraph_franka.perception.calibration import write_calibration as write_calibration
from contactgraph_franka.perception.camera import Camera as Camera
from contactgraph_franka.perception.camera import CameraFrame as CameraFrame
from contactgraph_franka.perception.camera import Intrinsics as Intrinsics
from contactgraph_franka.perception.tracker import Estimate as Estimate
from contactgraph_franka.perception.tracker import ObjectTracker as ObjectTracker
