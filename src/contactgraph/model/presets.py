"""This package's model, *ours*, as a composition of parts, and its ablations.

A preset is a function of a `ModelConfig` and a random key that returns a `ContactDynamics` with
fresh weights; any such function can be trained in the place of these.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import jax
from jaxtyping import PRNGKeyArray

from contactgraph.data.actuation_fit import ActuationFit
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.impact_fit import Impacts
from contactgraph.model.actuation import Actuation
from contactgraph.model.body_starts import told_numbers, with_impacts, with_shapes, with_slowing
from contactgraph.model.collision import ClosestApproachPrior, NoCutoff, SmoothCutoff
from contactgraph.model.contact_belief import ArgmaxSample
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.contact_law import ContactLaw
from contactgraph.model.edge_inference import EdgeInference, PriorEdges, TransitionEdges
from contactgraph.model.features import InvariantFeatures
from contactgraph.model.local_dynamics import (
    SpringMassDamperDynamics,
    ThetaMethod,
)
from contactgraph.model.message_passing import EdgeNetwork, MessagePassing, TypedMessagePassing
from contactgraph.model.motion_noise import PredictionNoise
from contactgraph.model.paper import MemorylessEdges, RecurrentEdges

_MOST = 1024
"""Of any width or count; bounds the memory that a damaged file can ask for."""
_MOST_EDGE_TYPES = 16
_MIN_TRANSITION, _MIN_TRANSITION_RATE = 2e-3, 0.04
"""Least probability of a transition in a step, and in a second of shorter steps."""


@dataclass(frozen=True)
class ModelConfig:
    """Properties of the data that a model is made for, and its size."""

    dimension: int
    """D, degrees of freedom per node."""
    control_size: int
    """U, components of the control. Component d moves degree of freedom d of actuated nodes, and
    further ones move nothing, except in `full_ab`."""
    dt: float
    """Length of a step, s."""
    contact_distance: float = 0.085
    """About the distance, centre to centre, at which bodies touch (the paper's d_th), m."""
    width: int | None = None
    """Of the networks. None: the preset's own, 64 for the paper's literal models, else 32."""
    learned_contact_distance: bool = True
    """Whether `contact_distance` is only the start of a learned one."""
    node_types: tuple[str, ...] = ()
    """Names of node types, passive ones first. Empty: passive and actuated ones."""
    actuation: Mapping[str, ActuationFit] = field(default_factory=dict)
    """How the control drives each actuated type at the start of training, by name."""
    driving_size: int | None = None
    """Components of the control that drive bodies, which come first. None: the first D."""
    actuated_nodes: int = 1
    """Most actuated nodes of a scene."""
    plane_distance: Mapping[str, float] = field(default_factory=dict)
    """m; how near each type comes to a plane; else half the contact distance."""
    boxes: bool = False
    """Whether nodes that have a size are boxes along the axes; else all are round."""
    margin: float = 0.0
    """m; gap at which two outlines touch."""
    turn_length: float | None = None
    """See `generalized_coordinates`, m. None: no body turns."""
    inertia: Mapping[str, float | Sequence[float]] = field(default_factory=dict)
    """Squared radius of gyration at the start, in units of `turn_length`, of types that turn."""
    substeps: int = 1
    """See `ContactDynamics`."""
    slowing: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Deceleration, m/s^2, and damper, 1/s, by the ground at the start, by type; else nearly 0."""
    impacts: Mapping[tuple[str, str], Impacts] = field(default_factory=dict)
    """Bounce, friction and ratios of masses at the start of training, of pairs of types."""
    averaged: bool = False
    """Whether velocities are means over the step before, such as backward differences."""
    speed: float = 1.0
    """Unit of speeds, m/s; for data in other units than metres, what 1 m/s is in them."""
    theta: float = 0.55
    """Start of the learned implicitness: see `ThetaMethod`."""
    varying_mass: bool = False
    """Whether masses differ within a type."""
    rough: bool = False
    """Whether touches bounce or rub, or bodies rub on the ground; else only dampers slow bodies."""
    friction: float = 1.0
    """Start of the coefficient of friction between bodies. Without any, only holds would explain
    that bodies go along with each other."""
    identified: bool = False
    """Whether bodies touch where their outlines tell, and `identify_laws` finds all else."""
    hinges: bool = False
    """Whether bodies may be hinged; only for the paper's forms, as what follows."""
    star: bool = False
    """Whether edges join actuated nodes with others alone."""
    temperature: float = 0.15
    """See `RecurrentEdges`."""
    gumbel: bool = False
    """Whether edges are sampled in training, not the likeliest."""
    edge_types: int = 3
    """K of a filter: free, touch, then types that hold; of 2, free and hold. Others have 2."""

    def __post_init__(self) -> None:
        counts = "dimension", "control_size", "width", "actuated_nodes", "driving_size", "substeps"
        sizes = {name: getattr(self, name) for name in counts}
        for name, size in (*sizes.items(), ("node_types", len(self.node_types))):
            if size is not None and not 0 <= size <= _MOST:
                raise InvalidInputError(f"{name} must be 0 to {_MOST}, found {size}")
        if not 2 <= self.edge_types <= _MOST_EDGE_TYPES:
            raise InvalidInputError(
                f"edge_types must be 2 to {_MOST_EDGE_TYPES}: free (0), touch (1) and types that "
                f"hold, or free and hold; found {self.edge_types}"
            )

    @property
    def told(self) -> tuple[str, ...]:
        """See `ContactLaw.told`; means over a step do not tell what stops a body within one."""
        most_damped = 1.0 / self.dt if self.averaged else math.inf
        return told_numbers(self.slowing, self.impacts, self.node_types, most_damped)


class Preset(Protocol):
    """A function that makes a model with fresh weights."""

    def __call__(self, config: ModelConfig, /, *, key: PRNGKeyArray) -> ContactDynamics:
        """The model for this configuration."""


class Inference(StrEnum):
    """Which edges are active, and by what; all but the filter are ablations, and have two types."""

    FILTER = "filter"
    """A hidden Markov filter: see `TransitionEdges`."""
    RECURRENT = "recurrent"
    """The paper's recurrent cell."""
    MEMORYLESS = "memoryless"
    NONE = "none"
    """Every edge is active at every step, at any distance."""


def ours(
    config: ModelConfig, *, key: PRNGKeyArray, inference: Inference = Inference.FILTER
) -> ContactDynamics:
    """Inferred edges with a cutoff, and bodies of types whose contacts are solved together."""
    model_key, messages_key, rates_key = jax.random.split(key, 3)
    distance, width = config.contact_distance, config.width or 32
    filtered = inference is Inference.FILTER
    config = config if filtered else dataclasses.replace(config, edge_types=2)
    features = InvariantFeatures(
        distance,
        config.speed,
        learned=config.learned_contact_distance,
        types=config.node_types,
        boxes=config.boxes,
        turning=tuple(config.inertia),
        turn_length=config.turn_length,
        margin=config.margin,
    )
    size = features.edge_size(config.dimension)
    driving = config.driving_size
    driving = min(config.dimension, config.control_size) if driving is None else driving
    noise: PredictionNoise | None = None
    edges: EdgeInference = PriorEdges(least=1.0)
    if filtered and config.identified:  # Nothing holds another, and outlines tell where they touch.
        edges = PriorEdges(config.edge_types)
    elif filtered:
        node_types, commands = features.node_types, config.control_size - driving
        edges = TransitionEdges(
            EdgeNetwork(size + 1 + commands + node_types, width, key=messages_key),
            node_types=node_types,
            edge_types=config.edge_types,
            commands=commands,
            min_transition=min(_MIN_TRANSITION, _MIN_TRANSITION_RATE * config.dt),
            key=rates_key,
        )
        noise = PredictionNoise(config.edge_types, distance)
    elif inference is not Inference.NONE:
        messages = EdgeNetwork(size, width, key=messages_key)
        cell = RecurrentEdges if inference is Inference.RECURRENT else MemorylessEdges
        edges = cell(messages, key=rates_key)
    keys = (jax.random.fold_in(key, index) for index in range(config.edge_types - 1))
    types: list[MessagePassing | EdgeNetwork] = [EdgeNetwork(size, width, key=k) for k in keys]
    learned = not config.averaged
    return ContactDynamics(
        inference=edges,
        local_dynamics=SpringMassDamperDynamics(
            TypedMessagePassing(types),
            _law(config, features, width, driving, jax.random.fold_in(model_key, 1)),
            ThetaMethod(config.theta if learned else 1.0, learned),
        ),
        features=features,
        prior=ClosestApproachPrior(),
        cutoff=NoCutoff() if inference is Inference.NONE else default_cutoff(config),
        sample=ArgmaxSample(),
        dt=config.dt,
        dimension=config.dimension,
        control_size=config.control_size,
        prediction_noise=noise,
        substeps=config.substeps,
    )


def _law(
    config: ModelConfig, features: InvariantFeatures, width: int, driving: int, key: PRNGKeyArray
) -> ContactLaw:
    types = config.node_types or ("object", "actuated")
    with jax.ensure_compile_time_eval():  # starts are numbers, also where shapes alone are asked
        drives = Actuation.from_fits(types, config.dimension, driving, config.actuation)
    head = ContactLaw(
        width,
        len(types),
        length=config.contact_distance,
        actuation=drives,
        slots=config.actuated_nodes,
        averaged=config.averaged,
        speed=config.speed,
        turn_length=config.turn_length,
        varying_mass=config.varying_mass,
        identified=config.identified,
        rough=config.rough,
        friction=config.friction,
        told=config.told,
        key=key,
    )
    head = with_shapes(head, config.plane_distance, config.inertia, types)
    head = with_slowing(head, [config.slowing.get(name, (0.0, 0.0)) for name in types])
    return with_impacts(head, config.impacts, types)


def default_cutoff(config: ModelConfig) -> SmoothCutoff:
    """From 1.5 to 2.5 contact distances."""
    distance = config.contact_distance
    return SmoothCutoff(inner=1.5 * distance, outer=2.5 * distance)
