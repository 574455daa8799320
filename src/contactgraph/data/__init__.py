"""Recorded runs: what they hold, how they are stored, and how they are cut into batches."""

from contactgraph.data.errors import InvalidInputError as InvalidInputError
from contactgraph.data.scene import Scene as Scene
from contactgraph.data.trajectory import Trajectory as Trajectory
