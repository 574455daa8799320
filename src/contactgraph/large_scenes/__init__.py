"""Scenes of many nodes: near pairs alone are edges, and groups of coupled nodes are solved alone.

A model reaches this package by its ``neighbor_list`` alone; without one it needs nothing of it.
"""

from contactgraph.large_scenes.neighbor_list import NeighborList as NeighborList
from contactgraph.large_scenes.neighbor_list import ReallocatingModel as ReallocatingModel
from contactgraph.large_scenes.neighbor_list import (
    allocate_neighbor_list as allocate_neighbor_list,
)
