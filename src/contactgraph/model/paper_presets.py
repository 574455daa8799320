"""Presets in the paper's own form, for comparison."""

import dataclasses

import jax
from jaxtyping import PRNGKeyArray

from contactgraph.model.collision import ClosestApproachPrior, DistancePrior, NoCutoff
from contactgraph.model.contact_belief import ArgmaxSample
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.edge_inference import AllEdges, RecurrentEdges
from contactgraph.model.features import AbsoluteFeatures
from contactgraph.model.heads import PerDegreeHead
from contactgraph.model.local_dynamics import (
    FreeLinearDynamics,
    SpringMassDamperDynamics,
    ThetaMethod,
)
from contactgraph.model.message_passing import MessagePassing, TypedMessagePassing
from contactgraph.model.presets import ModelConfig, default_cutoff


def full_ab(config: ModelConfig, *, key: PRNGKeyArray) -> ContactDynamics:
    """Recurrent edges with a cutoff, as in `gim_temp`, but free matrices of absolute positions."""
    config = dataclasses.replace(config, width=config.width or 32)
    model = paper_literal(config, key=key)
    return dataclasses.replace(
        model,
        local_dynamics=FreeLinearDynamics(
            model.local_dynamics.message_passing,
            dimension=config.dimension,
            control_size=config.control_size,
            key=jax.random.fold_in(key, 1),
        ),
        prior=ClosestApproachPrior(),
        cutoff=default_cutoff(config),
    )


def paper_literal(config: ModelConfig, *, key: PRNGKeyArray) -> ContactDynamics:
    """The paper's own form: all pairs, absolute positions, distance only, explicit Euler."""
    dimension, width = config.dimension, config.width or 64
    inference_key, cell_key, dynamics_key, head_key = jax.random.split(key, 4)
    features = AbsoluteFeatures(hinges=config.hinges)
    sizes = features.node_size(dimension), features.edge_size(dimension), width
    return ContactDynamics(
        inference=RecurrentEdges(MessagePassing(*sizes, key=inference_key), key=cell_key),
        local_dynamics=SpringMassDamperDynamics(
            message_passing=TypedMessagePassing([MessagePassing(*sizes, key=dynamics_key)]),
            head=PerDegreeHead(width, dimension, key=head_key),
            discretization=ThetaMethod(0.0, learned=False),
        ),
        features=features,
        prior=DistancePrior(threshold=config.contact_distance),
        cutoff=NoCutoff(),
        sample=ArgmaxSample(),
        dt=config.dt,
        dimension=dimension,
        control_size=config.control_size,
    )


def paper_literal_no_gim(config: ModelConfig, *, key: PRNGKeyArray) -> ContactDynamics:
    """The paper's own form without inference: every edge is active at every step."""
    return dataclasses.replace(paper_literal(config, key=key), inference=AllEdges())
