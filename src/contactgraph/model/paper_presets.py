"""Presets in the paper's own form, and in one that is cared for; and what the paper compares.

A name is that of a form, `paper-literal` or `paper-local`, and of what it has instead of the whole
model, such as `paper-literal-no-gim`.
"""

import dataclasses
from enum import StrEnum
from functools import partial

import jax
from jaxtyping import PRNGKeyArray

from contactgraph.model.contact_belief import ArgmaxSample, GumbelSample
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.edge_inference import (
    AllEdges,
    EdgeInference,
    MemorylessEdges,
    RecurrentEdges,
)
from contactgraph.model.edges import ClosestApproachPrior, DistancePrior, NoCutoff
from contactgraph.model.features import AbsoluteFeatures
from contactgraph.model.heads import PerDegreeHead
from contactgraph.model.local_dynamics import (
    FreeLinearDynamics,
    SpringMassDamperDynamics,
    ThetaMethod,
)
from contactgraph.model.message_passing import MessagePassing, TypedMessagePassing
from contactgraph.model.presets import ModelConfig, Preset, default_cutoff


class Compared(StrEnum):
    """The models that the paper compares."""

    GIM_TEMP = ""
    GIM_NON_TEMP = "-non-temp"
    NO_GIM = "-no-gim"
    FULL_AB = "-full-ab"


def paper_form(
    config: ModelConfig, *, key: PRNGKeyArray, local: bool, compared: Compared
) -> ContactDynamics:
    """A model in the paper's own form; its d_th is `ModelConfig.contact_distance`.

    All pairs, absolute positions, distance only, explicit Euler. A ``local`` one is cared for: near
    nodes alone have messages, if edges are inferred, and the theta of its step is learned.
    """
    dimension, width = config.dimension, config.width or 64
    inference_key, cell_key, dynamics_key, head_key = jax.random.split(key, 4)
    features = AbsoluteFeatures(hinges=config.hinges)
    sizes = features.node_size(dimension), features.edge_size(dimension), width
    messages = MessagePassing(*sizes, key=inference_key)
    inference: EdgeInference = RecurrentEdges(
        messages, temperature=config.temperature, key=cell_key
    )
    if compared is Compared.GIM_NON_TEMP:
        inference = MemorylessEdges(messages, key=cell_key)
    elif compared is Compared.NO_GIM:
        inference = AllEdges()
    along = TypedMessagePassing([MessagePassing(*sizes, key=dynamics_key)])
    dynamics: SpringMassDamperDynamics | FreeLinearDynamics = SpringMassDamperDynamics(
        message_passing=along,
        head=PerDegreeHead(width, dimension, key=head_key),
        discretization=ThetaMethod() if local else ThetaMethod(0.0, learned=False),
    )
    if compared is Compared.FULL_AB:
        size, head_key = config.control_size, jax.random.fold_in(key, 1)
        dynamics = FreeLinearDynamics(along, dimension=dimension, control_size=size, key=head_key)
    inferred = compared is not Compared.NO_GIM
    return ContactDynamics(
        inference=inference,
        local_dynamics=dynamics,
        features=features,
        prior=DistancePrior(threshold=config.contact_distance),
        cutoff=default_cutoff(config) if local and inferred else NoCutoff(),
        sample=GumbelSample() if config.gumbel else ArgmaxSample(),
        dt=config.dt,
        dimension=dimension,
        control_size=config.control_size,
        star=config.star,
    )


paper_literal: Preset = partial(paper_form, local=False, compared=Compared.GIM_TEMP)
PAPER_PRESETS: dict[str, Preset] = {
    f"paper-{form}{compared}": partial(paper_form, local=local, compared=compared)
    for form, local in (("literal", False), ("local", True))
    for compared in Compared
}
"""By name."""


def full_ab(config: ModelConfig, *, key: PRNGKeyArray) -> ContactDynamics:
    """Recurrent edges with a cutoff, as of `ours`, but free matrices of absolute positions."""
    config = dataclasses.replace(config, width=config.width or 32)
    model = paper_form(config, key=key, local=False, compared=Compared.FULL_AB)
    return dataclasses.replace(model, prior=ClosestApproachPrior(), cutoff=default_cutoff(config))
