"""The paper's models, each a composition of the same parts.

Every function takes the number of degrees of freedom a node `dimension`, the size of the control,
the step `dt` [s], the distance `contact_distance` [m] at about which bodies touch, centre to centre
(the paper's d_th), the networks' width, whether bodies may hang on hinges, whether they have weight
and rest on something until lifted (`GroundSupport`), whether the contact distance is learned
(these two in `gim_temp` and what is made of it alone), and a random key.
"""

import dataclasses
from typing import Protocol

import jax
from jaxtyping import PRNGKeyArray

from contactgraph.model.contact_belief import (
    ArgmaxSample,
    ClosestApproachPrior,
    DistancePrior,
    NoCutoff,
    SmoothCutoff,
)
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.edge_inference import AllEdges, MemorylessEdges, RecurrentEdges
from contactgraph.model.features import AbsoluteFeatures, InvariantFeatures
from contactgraph.model.heads import CoupledHead, GroundSupport, PerDegreeHead
from contactgraph.model.local_dynamics import (
    FreeLinearDynamics,
    SpringMassDamperDynamics,
    ThetaMethod,
)
from contactgraph.model.message_passing import EdgeNetwork, MessagePassing, TypedMessagePassing


class Preset(Protocol):
    """What makes one of the paper's models."""

    def __call__(
        self,
        dimension: int,
        control_size: int,
        dt: float,
        contact_distance: float = 0.085,
        width: int = 32,
        hinges: bool = False,
        weight: bool = False,
        learned_contact_distance: bool = True,
        *,
        key: PRNGKeyArray,
    ) -> ContactDynamics:
        """The model with fresh weights."""


def gim_temp(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.085,
    width: int = 32,
    hinges: bool = False,
    weight: bool = False,
    learned_contact_distance: bool = True,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """Recurrent edges; bodies that hold are solved as groups; local, and blind to the axes."""
    features = InvariantFeatures(contact_distance, hinges=hinges, learned=learned_contact_distance)
    messages_key, cell_key, dynamics_key = jax.random.split(key, 3)
    messages = EdgeNetwork(features.edge_size(dimension), width, key=messages_key)
    return ContactDynamics(
        inference=RecurrentEdges(messages, key=cell_key),
        local_dynamics=_coupled(features, dimension, contact_distance, width, weight, dynamics_key),
        features=features,
        prior=ClosestApproachPrior(),
        cutoff=_cutoff(contact_distance),
        sample=ArgmaxSample(),
        dt=dt,
        dimension=dimension,
        control_size=control_size,
    )


def gim_non_temp(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.085,
    width: int = 32,
    hinges: bool = False,
    weight: bool = False,
    learned_contact_distance: bool = True,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """As `gim_temp`, but its edges have no memory."""
    model_key, messages_key, output_key = jax.random.split(key, 3)
    model = gim_temp(
        dimension,
        control_size,
        dt,
        contact_distance,
        width,
        hinges,
        weight,
        learned_contact_distance,
        key=model_key,
    )
    messages = EdgeNetwork(model.features.edge_size(dimension), width, key=messages_key)
    return dataclasses.replace(model, inference=MemorylessEdges(messages, key=output_key))


def no_gim(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.085,
    width: int = 32,
    hinges: bool = False,
    weight: bool = False,
    learned_contact_distance: bool = True,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """No inference: every edge is active at every step, at any distance."""
    model = gim_temp(
        dimension,
        control_size,
        dt,
        contact_distance,
        width,
        hinges,
        weight,
        learned_contact_distance,
        key=key,
    )
    return dataclasses.replace(model, inference=AllEdges(), cutoff=NoCutoff())


def full_ab(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.085,
    width: int = 32,
    hinges: bool = False,
    weight: bool = False,
    learned_contact_distance: bool = True,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """Recurrent, local edges as in `gim_temp`, but free matrices, of absolute positions."""
    model = paper_literal(
        dimension,
        control_size,
        dt,
        contact_distance,
        width,
        hinges,
        weight,
        learned_contact_distance,
        key=key,
    )
    return dataclasses.replace(
        model,
        local_dynamics=FreeLinearDynamics(
            model.local_dynamics.message_passing,
            dimension=dimension,
            control_size=control_size,
            key=jax.random.fold_in(key, 1),
        ),
        prior=ClosestApproachPrior(),
        cutoff=_cutoff(contact_distance),
    )


def paper_literal(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.085,
    width: int = 64,
    hinges: bool = False,
    weight: bool = False,
    learned_contact_distance: bool = True,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """The paper's own form: all pairs, absolute positions, distance only, explicit Euler."""
    messages_key, cell_key, dynamics_key, head_key = jax.random.split(key, 4)
    features = AbsoluteFeatures(hinges=hinges)
    messages = _messages(features, dimension, width, messages_key)
    passing = TypedMessagePassing([_messages(features, dimension, width, dynamics_key)])
    return ContactDynamics(
        inference=RecurrentEdges(messages, key=cell_key),
        local_dynamics=SpringMassDamperDynamics(
            message_passing=passing,
            head=PerDegreeHead(width, dimension, key=head_key),
            discretization=ThetaMethod(0.0, learned=False),
        ),
        features=features,
        prior=DistancePrior(threshold=contact_distance),
        cutoff=NoCutoff(),
        sample=ArgmaxSample(),
        dt=dt,
        dimension=dimension,
        control_size=control_size,
    )


def paper_literal_no_gim(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.085,
    width: int = 64,
    hinges: bool = False,
    weight: bool = False,
    learned_contact_distance: bool = True,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """The paper's own form without inference: every edge is active at every step."""
    model = paper_literal(
        dimension,
        control_size,
        dt,
        contact_distance,
        width,
        hinges,
        weight,
        learned_contact_distance,
        key=key,
    )
    return dataclasses.replace(model, inference=AllEdges())


def _messages(
    features: InvariantFeatures | AbsoluteFeatures,
    dimension: int,
    width: int,
    key: PRNGKeyArray,
) -> MessagePassing:
    node_size, edge_size = features.node_size(dimension), features.edge_size(dimension)
    return MessagePassing(node_size, edge_size, width, key=key)


def _coupled(
    features: InvariantFeatures,
    dimension: int,
    contact_distance: float,
    width: int,
    weight: bool,
    key: PRNGKeyArray,
) -> SpringMassDamperDynamics:
    messages_key, head_key = jax.random.split(key)
    # What an edge does is its own affair; the head solves for what follows from all of them.
    messages = EdgeNetwork(features.edge_size(dimension), width, key=messages_key)
    return SpringMassDamperDynamics(
        message_passing=TypedMessagePassing([messages]),
        head=CoupledHead(
            width,
            features.node_types,
            length=contact_distance,
            support=GroundSupport(features.node_types, dimension) if weight else None,
            key=head_key,
        ),
        discretization=ThetaMethod(),
    )


def _cutoff(contact_distance: float) -> SmoothCutoff:
    return SmoothCutoff(inner=1.5 * contact_distance, outer=2.5 * contact_distance)
