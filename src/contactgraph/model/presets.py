"""The paper's models, each a composition of the same parts.

Every function takes the number of degrees of freedom a node `dimension`, the size of the control,
the step `dt` [s], the distance `contact_distance` [m] at about which bodies touch, centre to centre
(the paper's d_th), the networks' width, and a random key.
"""

import jax
from jaxtyping import PRNGKeyArray

from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.features import AbsoluteFeatures, InvariantFeatures
from contactgraph.model.heads import CoupledHead, PerDegreeHead
from contactgraph.model.inference import AllEdges, MemorylessEdges, RecurrentEdges
from contactgraph.model.local_dynamics import FreeLinearDynamics, SpringMassDamperDynamics
from contactgraph.model.message_passing import MessagePassing, TypedMessagePassing
from contactgraph.model.prior import DistancePrior
from contactgraph.model.reach import Everywhere, Reach
from contactgraph.model.sampling import ArgmaxSample
from contactgraph.model.theta_method import ThetaMethod


def gim_temp(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.1,
    width: int = 32,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """Recurrent edges and coupled springs and dampers; local, and blind to the choice of axes."""
    inference_key, cell_key, dynamics_key = jax.random.split(key, 3)
    features = InvariantFeatures(length=contact_distance)
    messages = _messages(features, dimension, width, inference_key)
    return ContactDynamics(
        inference=RecurrentEdges(messages, key=cell_key),
        local_dynamics=_coupled(features, dimension, dt, contact_distance, width, dynamics_key),
        features=features,
        prior=DistancePrior(threshold=contact_distance),
        reach=_reach(contact_distance),
        sample=ArgmaxSample(),
        dt=dt,
        dimension=dimension,
        control_size=control_size,
    )


def gim_non_temp(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.1,
    width: int = 32,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """As `gim_temp`, but its edges have no memory."""
    inference_key, output_key, dynamics_key = jax.random.split(key, 3)
    features = InvariantFeatures(length=contact_distance)
    messages = _messages(features, dimension, width, inference_key)
    return ContactDynamics(
        inference=MemorylessEdges(messages, key=output_key),
        local_dynamics=_coupled(features, dimension, dt, contact_distance, width, dynamics_key),
        features=features,
        prior=DistancePrior(threshold=contact_distance),
        reach=_reach(contact_distance),
        sample=ArgmaxSample(),
        dt=dt,
        dimension=dimension,
        control_size=control_size,
    )


def no_gim(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.1,
    width: int = 32,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """No inference: every edge is active at every step, at any distance."""
    features = InvariantFeatures(length=contact_distance)
    return ContactDynamics(
        inference=AllEdges(),
        local_dynamics=_coupled(features, dimension, dt, contact_distance, width, key),
        features=features,
        prior=DistancePrior(threshold=contact_distance),
        reach=Everywhere(),
        sample=ArgmaxSample(),
        dt=dt,
        dimension=dimension,
        control_size=control_size,
    )


def full_ab(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.1,
    width: int = 32,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """As the paper's model, but with free matrices in place of spring-mass-dampers."""
    inference_key, cell_key, dynamics_key, head_key = jax.random.split(key, 4)
    features = AbsoluteFeatures()
    passing = TypedMessagePassing([_messages(features, dimension, width, dynamics_key)])
    return ContactDynamics(
        inference=RecurrentEdges(
            _messages(features, dimension, width, inference_key), key=cell_key
        ),
        local_dynamics=FreeLinearDynamics(
            passing, dimension=dimension, control_size=control_size, key=head_key
        ),
        features=features,
        prior=DistancePrior(threshold=contact_distance),
        reach=_reach(contact_distance),
        sample=ArgmaxSample(),
        dt=dt,
        dimension=dimension,
        control_size=control_size,
    )


def paper_literal(
    dimension: int,
    control_size: int,
    dt: float,
    contact_distance: float = 0.1,
    width: int = 64,
    *,
    key: PRNGKeyArray,
) -> ContactDynamics:
    """The paper's own form: all pairs, absolute positions, distance only, explicit Euler."""
    inference_key, cell_key, dynamics_key, head_key = jax.random.split(key, 4)
    features = AbsoluteFeatures()
    passing = TypedMessagePassing([_messages(features, dimension, width, dynamics_key)])
    return ContactDynamics(
        inference=RecurrentEdges(
            _messages(features, dimension, width, inference_key), key=cell_key
        ),
        local_dynamics=SpringMassDamperDynamics(
            message_passing=passing,
            head=PerDegreeHead(width, dimension, key=head_key),
            discretisation=ThetaMethod(0.0, learned=False),
        ),
        features=features,
        prior=DistancePrior(threshold=contact_distance, inside=0.1, outside=1.0, look_ahead=False),
        reach=Everywhere(),
        sample=ArgmaxSample(),
        dt=dt,
        dimension=dimension,
        control_size=control_size,
    )


def _messages(
    features: InvariantFeatures | AbsoluteFeatures,
    dimension: int,
    width: int,
    key: PRNGKeyArray,
) -> MessagePassing:
    return MessagePassing(
        features.node_size(dimension), features.edge_size(dimension), width, key=key
    )


def _coupled(
    features: InvariantFeatures,
    dimension: int,
    dt: float,
    contact_distance: float,
    width: int,
    key: PRNGKeyArray,
) -> SpringMassDamperDynamics:
    messages_key, head_key = jax.random.split(key)
    return SpringMassDamperDynamics(
        message_passing=TypedMessagePassing([_messages(features, dimension, width, messages_key)]),
        head=CoupledHead(width, length=contact_distance, dt=dt, key=head_key),
        discretisation=ThetaMethod(),
    )


def _reach(contact_distance: float) -> Reach:
    return Reach(near=1.5 * contact_distance, far=2.5 * contact_distance)
