"""Training: loss terms, the loop, and checkpoints that survive anything."""

from contactgraph.train.checkpoint import load_checkpoint as load_checkpoint
from contactgraph.train.checkpoint import save_checkpoint as save_checkpoint
from contactgraph.train.fit import FitProgress as FitProgress
from contactgraph.train.fit import FitResult as FitResult
from contactgraph.train.fit import FitState as FitState
from contactgraph.train.fit import FitStatus as FitStatus
from contactgraph.train.fit import fit as fit
from contactgraph.train.fit import initial_state as initial_state
from contactgraph.train.loss import LossTerms as LossTerms
from contactgraph.train.recipe import Recipe as Recipe
from contactgraph.train.run_folder import RunFolder as RunFolder
from contactgraph.train.suited import Suited as Suited
from contactgraph.train.suited import suited_to as suited_to
