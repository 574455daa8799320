"""The model: inference of active contact edges, and local dynamics given them."""

from contactgraph.model.actuation import Actuation as Actuation
from contactgraph.model.actuation import ActuationFit as ActuationFit
from contactgraph.model.body_mass import MassBelief as MassBelief
from contactgraph.model.body_mass import correct_masses as correct_masses
from contactgraph.model.body_mass import first_masses as first_masses
from contactgraph.model.body_mass import told_log_mass as told_log_mass
from contactgraph.model.body_mass import with_masses as with_masses
from contactgraph.model.collision import ClosestApproachPrior as ClosestApproachPrior
from contactgraph.model.collision import DistancePrior as DistancePrior
from contactgraph.model.collision import NoCutoff as NoCutoff
from contactgraph.model.collision import SmoothCutoff as SmoothCutoff
from contactgraph.model.contact_belief import ArgmaxSample as ArgmaxSample
from contactgraph.model.contact_belief import ContactBelief as ContactBelief
from contactgraph.model.contact_belief import ContactSensor as ContactSensor
from contactgraph.model.contact_belief import GumbelSample as GumbelSample
from contactgraph.model.contact_belief import cast_like as cast_like
from contactgraph.model.contact_belief import correct as correct
from contactgraph.model.contact_belief import default_sensor as default_sensor
from contactgraph.model.contact_belief import two_type_belief as two_type_belief
from contactgraph.model.contact_dynamics import ContactDynamics as ContactDynamics
from contactgraph.model.contact_law import ContactLaw as ContactLaw
from contactgraph.model.edge_inference import AllEdges as AllEdges
from contactgraph.model.edge_inference import MemorylessEdges as MemorylessEdges
from contactgraph.model.edge_inference import PriorEdges as PriorEdges
from contactgraph.model.edge_inference import RecurrentEdges as RecurrentEdges
from contactgraph.model.edge_inference import TransitionEdges as TransitionEdges
from contactgraph.model.features import AbsoluteFeatures as AbsoluteFeatures
from contactgraph.model.features import InvariantFeatures as InvariantFeatures
from contactgraph.model.features import turn_length_of as turn_length_of
from contactgraph.model.heads import PerDegreeHead as PerDegreeHead
from contactgraph.model.interaction_cutoff import InteractionCutoff as InteractionCutoff
from contactgraph.model.interaction_cutoff import interaction_cutoff as interaction_cutoff
from contactgraph.model.io import PRESETS as PRESETS
from contactgraph.model.io import ModelSummary as ModelSummary
from contactgraph.model.io import StoredModel as StoredModel
from contactgraph.model.io import describe_model as describe_model
from contactgraph.model.io import load_model as load_model
from contactgraph.model.io import save_model as save_model
from contactgraph.model.io import shipped_model as shipped_model
from contactgraph.model.io import shipped_models as shipped_models
from contactgraph.model.local_dynamics import FreeLinearDynamics as FreeLinearDynamics
from contactgraph.model.local_dynamics import SpringMassDamperDynamics as SpringMassDamperDynamics
from contactgraph.model.local_dynamics import ThetaMethod as ThetaMethod
from contactgraph.model.message_passing import EdgeNetwork as EdgeNetwork
from contactgraph.model.message_passing import MessagePassing as MessagePassing
from contactgraph.model.message_passing import TypedMessagePassing as TypedMessagePassing
from contactgraph.model.motion_likelihood import MotionEvidence as MotionEvidence
from contactgraph.model.motion_likelihood import MotionNoise as MotionNoise
from contactgraph.model.motion_likelihood import check_motion_model as check_motion_model
from contactgraph.model.motion_likelihood import (
    contact_log_likelihood_ratio as contact_log_likelihood_ratio,
)
from contactgraph.model.motion_likelihood import correct_by_motion as correct_by_motion
from contactgraph.model.motion_likelihood import motion_noise as motion_noise
from contactgraph.model.neighbor_allocation import ReallocatingModel as ReallocatingModel
from contactgraph.model.neighbor_allocation import allocate_neighbor_list as allocate_neighbor_list
from contactgraph.model.neighbor_list import NeighborList as NeighborList
from contactgraph.model.neighbor_list import sum_at_nodes as sum_at_nodes
from contactgraph.model.paper_presets import PAPER_PRESETS as PAPER_PRESETS
from contactgraph.model.paper_presets import full_ab as full_ab
from contactgraph.model.paper_presets import paper_literal as paper_literal
from contactgraph.model.presets import Impacts as Impacts
from contactgraph.model.presets import Inference as Inference
from contactgraph.model.presets import ModelConfig as ModelConfig
from contactgraph.model.presets import Preset as Preset
from contactgraph.model.presets import ours as ours
from contactgraph.model.program_store import note_bindings
from contactgraph.model.relation_model import relations as relations
from contactgraph.model.rollout import control_sensitivity as control_sensitivity
from contactgraph.model.rollout import rollout as rollout
from contactgraph.model.rollout import take_step as take_step
from contactgraph.model.rollout import with_control_displacement as with_control_displacement
from contactgraph.model.serialization import module_arrays as module_arrays
from contactgraph.model.serialization import with_arrays as with_arrays
from contactgraph.model.types import EncodedGraph as EncodedGraph
from contactgraph.model.types import LinearDynamics as LinearDynamics
from contactgraph.model.types import LocalInput as LocalInput
from contactgraph.model.types import ModelState as ModelState
from contactgraph.model.types import Nodes as Nodes
from contactgraph.model.types import SpringMassDamper as SpringMassDamper
from contactgraph.model.types import Step as Step
from contactgraph.model.types import StepModel as StepModel
from contactgraph.model.types import StepStages as StepStages
from contactgraph.model.types import from_physical as from_physical
from contactgraph.model.types import scene_nodes as scene_nodes
from contactgraph.model.types import stack_state as stack_state

note_bindings("contactgraph.data")
note_bindings("contactgraph.model")
