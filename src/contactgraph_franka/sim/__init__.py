"""Everything of a real arm but the arm: its protocol, a tagged block, a camera that renders it."""

from contactgraph_franka.sim.camera_settings import CameraSettings as CameraSettings
from contactgraph_franka.sim.rehearsal import Rehearsal as Rehearsal
from contactgraph_franka.sim.rehearsal import RunningRehearsal as RunningRehearsal
from contactgraph_franka.sim.rehearsal import attach as attach
from contactgraph_franka.sim.rehearsal import open_camera as open_camera
