"""Recordings of other formats: read by an import map, and written from datasets."""

from contactgraph.interchange.conversion import Conversion as Conversion
from contactgraph.interchange.conversion import to_trajectories as to_trajectories
from contactgraph.interchange.import_map import ImportMap as ImportMap
from contactgraph.interchange.import_map import read_map as read_map
from contactgraph.interchange.import_map import shipped_map_text as shipped_map_text
from contactgraph.interchange.import_map import shipped_maps as shipped_maps
from contactgraph.interchange.recording import Column as Column
from contactgraph.interchange.recording import Episode as Episode
from contactgraph.interchange.recording import Recording as Recording
