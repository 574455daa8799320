"""Everything of a real arm but the arm: its protocol, a tagged block, a camera that renders it."""

from contactgraph.rehearsal.camera_settings import CameraSettings as CameraSettings
from contactgraph.rehearsal.rehearsal import Rehearsal as Rehearsal
from contactgraph.rehearsal.rehearsal import RunningRehearsal as RunningRehearsal
from contactgraph.rehearsal.rehearsal import attach as attach
from contactgraph.rehearsal.rehearsal import open_camera as open_camera
