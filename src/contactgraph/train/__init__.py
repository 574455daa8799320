"""Training: objectives, the loop, and checkpoints that survive anything."""

from contactgraph.train.fit import FitProgress as FitProgress
from contactgraph.train.fit import FitResult as FitResult
from contactgraph.train.fit import FitStatus as FitStatus
from contactgraph.train.fit import fit as fit
from contactgraph.train.fit import initial_state as initial_state
from contactgraph.train.held_out import HeldOutBaselines as HeldOutBaselines
from contactgraph.train.identification import check_contacts as check_contacts
from contactgraph.train.identification import estimate_sensor as estimate_sensor
from contactgraph.train.objective import FitState as FitState
from contactgraph.train.objective import LossTerms as LossTerms
from contactgraph.train.objective import TrainConfig as TrainConfig
from contactgraph.train.run_folder import RunFolder as RunFolder
from contactgraph.train.run_folder import load_checkpoint as load_checkpoint
from contactgraph.train.run_folder import save_checkpoint as save_checkpoint
