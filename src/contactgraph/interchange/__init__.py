"""Recordings of other formats: read by an import map, and written from datasets."""

from contactgraph.interchange.conversion import to_trajectories as to_trajectories
from contactgraph.interchange.motion import pull_warning as pull_warning
from contactgraph.interchange.motion import pulls as pulls
from contactgraph.interchange.motion import velocity_mismatch as velocity_mismatch
from contactgraph.interchange.motion import velocity_warning as velocity_warning
from contactgraph.interchange.recording import Column as Column
from contactgraph.interchange.recording import Episode as Episode
from contactgraph.interchange.recording import Recording as Recording
from contactgraph.interchange.scene_map import SceneMap as SceneMap
from contactgraph.interchange.scene_map import parse_map as parse_map
from contactgraph.interchange.scene_map import read_map as read_map
from contactgraph.interchange.scene_map import shipped_maps as shipped_maps
