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

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from contactgraph.bodies.graph import HOLD, MOST_EDGE_TYPES, TOUCH, EdgeType, first_where
from contactgraph.bodies.message_passing import EdgeNetwork, MessagePassing, TypedMessagePassing
from contactgraph.data.errors import InvalidInputError
from contactgraph.dynamics.actuation import Actuation, ActuationFit
from contactgraph.dynamics.body_types import DECELERATION, PACE
from contactgraph.dynamics.contact_law import ContactLaw
from contactgraph.dynamics.local_dynamics import (
    SpringMassDamperDynamics,
    ThetaMethod,
)
from contactgraph.inference.contact_belief import ArgmaxSample
from contactgraph.inference.edge_inference import DurationEdges, EdgeInference, PriorEdges
from contactgraph.inference.features import (
    ClosestApproachPrior,
    InvariantFeatures,
    NoCutoff,
    SmoothCutoff,
)
from contactgraph.inference.motion_noise import PredictionNoise
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.paper import MemorylessEdges, RecurrentEdges

PLANE = "plane"
"""Stands for planes where types are named."""
_MOST = 1024
"""Of any width or count; bounds the memory that a damaged file can ask for."""
_TYPES = "object", "actuated"
_MIN_TRANSITION, _MIN_TRANSITION_RATE = 2e-3, 0.04
"""Least probability of a transition in a step, and in a second of shorter steps."""
_STRONG = 4.0
"""Control above nearly all, of a mean square of 1: no hold withstands it before training."""
_LEAST_SHARE, _MOST_SHARE = 1e-3, 0.99
"""Of bounce and friction."""


@dataclass(frozen=True)
class Impacts:
    """What bodies of two types show where they strike each other."""

    bounce: float
    """Share of the speed of approach with which they part."""
    friction: float | None
    """Coulomb's coefficient; None where too few slide on each other to the end."""
    mass_ratio: float | None
    """Of the first type's mass to the second's; None where either does not move."""


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
    edge_types: tuple[EdgeType, ...] = (TOUCH, HOLD)
    """The active types of a filter, see `usual_edge_types`; all others have one, which holds."""

    def __post_init__(self) -> None:
        counts = "dimension", "control_size", "width", "actuated_nodes", "driving_size", "substeps"
        sizes = {name: getattr(self, name) for name in counts}
        for name, size in (*sizes.items(), ("node_types", len(self.node_types))):
            if size is not None and not 0 <= size <= _MOST:
                raise InvalidInputError(f"{name} must be 0 to {_MOST}, found {size}")
        kinds = self.edge_types
        if not isinstance(kinds, tuple) or not 1 <= len(kinds) <= MOST_EDGE_TYPES:
            raise InvalidInputError(
                f"edge_types must be 1 to {MOST_EDGE_TYPES} active types, such as "
                f"usual_edge_types(3), touch and hold; found "
                f"{len(kinds) if isinstance(kinds, tuple) else kinds!r}"
            )

    @property
    def told(self) -> tuple[str, ...]:
        """`ContactLaw.told`: of `slowing`, where all types but the last, which is actuated, are
        seen to slide, and of `impacts`, where all types take part.

        Means over a step do not tell what stops a body within one.
        """
        most_damped = 1.0 / self.dt if self.averaged else math.inf
        slide = {name for name, (_, damper) in self.slowing.items() if damper < most_damped}
        rub = {pair for pair, each in self.impacts.items() if each.friction is not None}
        types, passive = set(self.node_types), set(self.node_types[:-1])
        met, rubbed = ({name for pair in pairs for name in pair} for pairs in (self.impacts, rub))
        return (
            *(("deceleration_raw", "damper_raw") if slide and slide >= passive else ()),
            *(("bounce_raw",) if met and met >= types else ()),
            *(("friction_raw",) if rubbed and rubbed >= types else ()),
        )


class Preset(Protocol):
    """A function that makes a model with fresh weights."""

    def __call__(self, config: ModelConfig, /, *, key: PRNGKeyArray) -> ContactDynamics:
        """The model for this configuration."""


class Inference(StrEnum):
    """Which edges are active, and by what; all but the filter are ablations, and have two types."""

    FILTER = "filter"
    """A hidden Markov filter: see `DurationEdges`."""
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
    config = config if filtered else dataclasses.replace(config, edge_types=(HOLD,))
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
        edges = PriorEdges(
            config.edge_types, first_where(each.unilateral for each in config.edge_types)
        )
    elif filtered:
        fits = [config.actuation.get(name) for name in config.node_types or _TYPES]
        push = max((np.abs(fit.matrix).max() for fit in fits if fit is not None), default=0.0)
        edges = DurationEdges(
            tuple(fit is not None and fit.stiffness + fit.damping > 0.0 for fit in fits),
            edge_types=config.edge_types,
            commands=config.control_size - driving,
            min_transition=min(_MIN_TRANSITION, _MIN_TRANSITION_RATE * config.dt),
            limit=_STRONG * push * config.dt**2 / distance or 1.0,
        )
        noise = PredictionNoise(distance)
    elif inference is not Inference.NONE:
        messages = EdgeNetwork(size, width, key=messages_key)
        cell = RecurrentEdges if inference is Inference.RECURRENT else MemorylessEdges
        edges = cell(messages, key=rates_key)
    keys = (jax.random.fold_in(key, index) for index in range(len(config.edge_types)))
    types: list[MessagePassing | EdgeNetwork] = [EdgeNetwork(size, width, key=k) for k in keys]
    learned = not config.averaged
    return ContactDynamics(
        inference=edges,
        local_dynamics=SpringMassDamperDynamics(
            TypedMessagePassing(types),
            _law(config, width, driving, jax.random.fold_in(model_key, 1)),
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


def _law(config: ModelConfig, width: int, driving: int, key: PRNGKeyArray) -> ContactLaw:
    types = config.node_types or _TYPES
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
    return _with_measured(head, config, types)


def default_cutoff(config: ModelConfig) -> SmoothCutoff:
    """From 1.5 to 2.5 contact distances."""
    distance = config.contact_distance
    return SmoothCutoff(inner=1.5 * distance, outer=2.5 * distance)


def _with_measured(law: ContactLaw, config: ModelConfig, types: Sequence[str]) -> ContactLaw:
    """With what ``config`` has of its ``types``: distances from planes, inertia, slowing by the
    ground, and masses, bounce and friction that fit what pairs of types show.

    Those of pairs are sums of what each type has, by least squares, and a type that is not seen has
    what the others have on average.
    """
    rates = np.array([config.slowing.get(name, (0.0, 0.0)) for name in types])
    rates = np.maximum(rates / [DECELERATION * law.speed, 1.0], np.log1p(np.exp(-6.0)))
    deceleration, damper = (_inverse_softplus(rates) + 6.0).T / PACE
    names = (*types, PLANE)
    ratio, bounce, friction = {}, {}, {}
    for pair, each in config.impacts.items():
        if not set(pair) <= set(names):
            continue
        share = np.clip(each.bounce, _LEAST_SHARE, _MOST_SHARE)
        bounce[pair] = np.log(share / (1.0 - share)) + 3.0
        if each.mass_ratio:
            ratio[pair] = np.log(each.mass_ratio)
        if each.friction is not None:
            friction[pair] = float(_inverse_softplus(max(each.friction, _LEAST_SHARE))) + 4.0
    log_mass = _fitted(PACE * np.append(law.log_mass, 0.0), names, ratio, second=-1.0)[:-1]
    values = {
        "plane_distance": [config.plane_distance.get(name, 0.5 * law.length) for name in types],
        "deceleration_raw": deceleration,
        "damper_raw": damper,
        # Ratios alone are seen: the lightest has the start's.
        "log_mass": (log_mass - log_mass.min()) / PACE,
        "bounce_raw": _shares(PACE * np.asarray(law.bounce_raw), names, bounce) / PACE,
        "friction_raw": _shares(PACE * np.asarray(law.friction_raw), names, friction) / PACE,
    }
    if law.log_inertia is not None:
        size = law.log_inertia.shape[1:]
        inertia = [np.broadcast_to(config.inertia.get(name, 1.0), size) for name in types]
        values["log_inertia"] = jnp.log(jnp.array(inertia)) / PACE
    typed = [jnp.asarray(each, law.log_mass.dtype) for each in values.values()]
    return eqx.tree_at(lambda each: [getattr(each, name) for name in values], law, typed)


def _shares(
    start: np.ndarray, names: Sequence[str], sums: Mapping[tuple[str, str], float]
) -> np.ndarray:
    """[types+1] whose sums are those of the pairs, from a start that is the mean of bodies'."""
    of_bodies = [each for pair, each in sums.items() if PLANE not in pair]
    if of_bodies:
        mean = 0.5 * float(np.mean(of_bodies))
        start = np.append(np.full(len(start) - 1, mean), start[-2] + start[-1] - mean)
    return _fitted(start, names, sums, second=1.0)


def _fitted(
    start: np.ndarray,
    names: Sequence[str],
    pairs: Mapping[tuple[str, str], float],
    *,
    second: float,
) -> np.ndarray:
    """The least squares solution nearest to ``start`` [types+1], of which the first of each pair
    plus ``second`` times the other is the value of the pair."""
    each = np.eye(len(names))
    every = [each[names.index(a)] + second * each[names.index(b)] for a, b in pairs]
    rows = np.reshape(every, (-1, len(names)))
    return np.asarray(
        start + np.linalg.pinv(rows) @ (np.array(list(pairs.values())) - rows @ start)
    )


def _inverse_softplus(value: np.ndarray | float) -> np.ndarray:
    return np.asarray(np.log(np.expm1(value)))
