"""Recorded trajectories: their fields, their files, and their batches for training."""

from contactgraph.data.atomic_file import atomic_write as atomic_write
from contactgraph.data.dataset import Dataset as Dataset
from contactgraph.data.dataset import Metadata as Metadata
from contactgraph.data.dataset import split_by_trajectory as split_by_trajectory
from contactgraph.data.dataset import strip_contacts as strip_contacts
from contactgraph.data.dataset import subsample as subsample
from contactgraph.data.dataset import with_edge_labels as with_edge_labels
from contactgraph.data.dataset import without_turns as without_turns
from contactgraph.data.dataset_file import read_trajectories as read_trajectories
from contactgraph.data.dataset_file import write_trajectories as write_trajectories
from contactgraph.data.errors import InvalidInputError as InvalidInputError
from contactgraph.data.graph import candidate_pairs as candidate_pairs
from contactgraph.data.graph import edge_id as edge_id
from contactgraph.data.graph import joined as joined
from contactgraph.data.graph import pair_count as pair_count
from contactgraph.data.graph import pair_indices as pair_indices
from contactgraph.data.scene import CONTROL_KINDS as CONTROL_KINDS
from contactgraph.data.scene import Scene as Scene
from contactgraph.data.trajectory import Trajectory as Trajectory
from contactgraph.data.trajectory_batch import Nodes as Nodes
from contactgraph.data.trajectory_batch import TrajectoryBatch as TrajectoryBatch
from contactgraph.data.trajectory_batch import (
    generalized_coordinates as generalized_coordinates,
)
from contactgraph.data.trajectory_batch import pad_trajectories as pad_trajectories
from contactgraph.data.windows import MOVES_M as MOVES_M
from contactgraph.data.windows import Windows as Windows
from contactgraph.data.windows import check_window_length as check_window_length
from contactgraph.data.windows import event_steps as event_steps
from contactgraph.data.windows import moving_bodies as moving_bodies
from contactgraph.data.windows import window_weights as window_weights
