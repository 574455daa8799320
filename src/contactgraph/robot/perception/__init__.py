"""Where tagged objects are: from camera frames to positions, velocities and how sure they are.

What needs a library of its own is imported by its module: `tags`, `sight`, `watch` and `perception`
the finder of tags, `realsense` the maker's library.
"""

from contactgraph.robot.perception.calibration import CalibrationResiduals as CalibrationResiduals
from contactgraph.robot.perception.calibration import CameraCalibration as CameraCalibration
from contactgraph.robot.perception.calibration import read_calibration as read_calibration
from contactgraph.robot.perception.calibration import write_calibration as write_calibration
from contactgraph.robot.perception.camera import Camera as Camera
from contactgraph.robot.perception.camera import CameraFrame as CameraFrame
from contactgraph.robot.perception.camera import Intrinsics as Intrinsics
from contactgraph.robot.perception.tagged_object import Tag as Tag
from contactgraph.robot.perception.tagged_object import TaggedObject as TaggedObject
from contactgraph.robot.perception.tagged_object import single_tag as single_tag
from contactgraph.robot.perception.tracker import Estimate as Estimate
from contactgraph.robot.perception.tracker import ObjectTracker as ObjectTracker
