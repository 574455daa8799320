"""Recorded runs: what they hold, how they are stored, and how they are cut into batches."""

from contactgraph.data.atomic_file import replacing as replacing
from contactgraph.data.dataset import Dataset as Dataset
from contactgraph.data.dataset import Metadata as Metadata
from contactgraph.data.dataset import split_by_run as split_by_run
from contactgraph.data.dataset import strip_contacts as strip_contacts
from contactgraph.data.errors import InvalidInputError as InvalidInputError
from contactgraph.data.events import event_steps as event_steps
from contactgraph.data.graph import candidate_pairs as candidate_pairs
from contactgraph.data.graph import edge_index as edge_index
from contactgraph.data.graph import joined as joined
from contactgraph.data.graph import pair_indices as pair_indices
from contactgraph.data.longer_steps import with_longer_steps as with_longer_steps
from contactgraph.data.padding import PaddedRuns as PaddedRuns
from contactgraph.data.padding import pad_runs as pad_runs
from contactgraph.data.scene import Scene as Scene
from contactgraph.data.storage import FileSummary as FileSummary
from contactgraph.data.storage import describe_file as describe_file
from contactgraph.data.storage import read_trajectories as read_trajectories
from contactgraph.data.storage import write_trajectories as write_trajectories
from contactgraph.data.trajectory import Trajectory as Trajectory
from contactgraph.data.windows import Windows as Windows
from contactgraph.data.windows import window_weights as window_weights
