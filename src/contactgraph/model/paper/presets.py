"""Presets in the paper's own form, and in one that is cared for; and what the paper compares.

A name is that of a form, `paper-literal` or `paper-local`, and of what it has instead of the whole
model, such as `paper-literal-no-gim`.
"""

import dataclasses
from functools import partial

import jax
from jaxtyping import PRNGKeyArray

from contactgraph.bodies.message_passing import MessagePassing, TypedMessagePassing
from contactgraph.dynamics.local_dynamics import (
    LocalDynamics,
    SpringMassDamperDynamics,
    ThetaMethod,
)
from contactgraph.inference.contact_belief import ArgmaxSample, GumbelSample
from contactgraph.inference.edge_inference import EdgeInference, PriorEdges
from contactgraph.inference.features import ClosestApproachPrior, NoCutoff
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.paper import (
    AbsoluteFeatures,
    DistancePrior,
    FreeLinearDynamics,
    MemorylessEdges,
    PerDegreeHead,
    RecurrentEdges,
)
from contactgraph.model.presets import Inference, ModelConfig, Preset, default_cutoff


def paper_form(
    config: ModelConfig,
    *,
    key: PRNGKeyArray,
    local: bool = False,
    inference: Inference = Inference.RECURRENT,
    free: bool = False,
) -> ContactDynamics:
    """A model in the paper's own form; its d_th is `ModelConfig.contact_distance`.

    All pairs, absolute positions, distance only, explicit Euler. A ``local`` one is cared for: near
    nodes alone have messages, if edges are inferred, and the theta of its step is learned. Matrices
    of a ``free`` one are not those of springs and dampers.
    """
    dimension, width = config.dimension, config.width or 64
    inference_key, cell_key, dynamics_key, head_key = jax.random.split(key, 4)
    features = AbsoluteFeatures(hinges=config.hinges)
    sizes = features.node_size(dimension), features.edge_size(dimension), width
    messages = MessagePassing(*sizes, key=inference_key)
    edges: EdgeInference = PriorEdges(least=1.0)
    if inference is Inference.RECURRENT:
        edges = RecurrentEdges(messages, temperature=config.temperature, key=cell_key)
    elif inference is Inference.MEMORYLESS:
        edges = MemorylessEdges(messages, key=cell_key)
    along = TypedMessagePassing([MessagePassing(*sizes, key=dynamics_key)])
    dynamics: LocalDynamics = SpringMassDamperDynamics(
        message_passing=along,
        head=PerDegreeHead(width, dimension, key=head_key),
        discretization=ThetaMethod() if local else ThetaMethod(0.0, learned=False),
    )
    if free:
        size, head_key = config.control_size, jax.random.fold_in(key, 1)
        dynamics = FreeLinearDynamics(along, dimension=dimension, control_size=size, key=head_key)
    inferred = inference is not Inference.NONE
    return ContactDynamics(
        inference=edges,
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


paper_literal: Preset = paper_form
PAPER_PRESETS: dict[str, Preset] = {
    f"paper-{form}{name}": partial(paper_form, local=local, **parts)
    for form, local in (("literal", False), ("local", True))
    for name, parts in (
        ("", {}),
        ("-non-temp", {"inference": Inference.MEMORYLESS}),
        ("-no-gim", {"inference": Inference.NONE}),
        ("-full-ab", {"free": True}),
    )
}
"""By name."""


def full_ab(config: ModelConfig, *, key: PRNGKeyArray) -> ContactDynamics:
    """Recurrent edges with a cutoff, as of `ours`, but free matrices of absolute positions."""
    config = dataclasses.replace(config, width=config.width or 32)
    model = paper_form(config, key=key, free=True)
    return dataclasses.replace(model, prior=ClosestApproachPrior(), cutoff=default_cutoff(config))
