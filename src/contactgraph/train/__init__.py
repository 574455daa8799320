"""Training: loss terms, the loop, and checkpoints that survive anything."""

from contactgraph.train.config import TrainConfig as TrainConfig
from contactgraph.train.filter_loss import check_contacts as check_contacts
from contactgraph.train.fit import fit as fit
from contactgraph.train.fit import initial_state as initial_state
from contactgraph.train.fit_state import FitProgress as FitProgress
from contactgraph.train.fit_state import FitResult as FitResult
from contactgraph.train.fit_state import FitState as FitState
from contactgraph.train.fit_state import FitStatus as FitStatus
from contactgraph.train.held_out import HeldOutBaselines as HeldOutBaselines
from contactgraph.train.loss import LossTerms as LossTerms
from contactgraph.train.run_folder import RunFolder as RunFolder
from contactgraph.train.run_folder import load_checkpoint as load_checkpoint
from contactgraph.train.run_folder import save_checkpoint as save_checkpoint
from contactgraph.train.sensor_estimate import estimate_sensor as estimate_sensor
