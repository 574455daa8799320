"""Expectation maximisation of relations that last: beliefs by the motion of whole trajectories.

The types of all edges of a trajectory are inferred from all its steps, without labels and without a
gradient. The force laws then minimise the expected negative log-likelihood of every step's
velocity, and the prior that of the types. At the start all laws are weak and the noise is large, so
that beliefs stay near 1/2 until the laws tell edges apart.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from contactgraph.data.dataset import Dataset
from contactgraph.model.contact_belief import ContactBelief
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.force_laws import RelationDynamics
from contactgraph.model.relations import StaticEdges, lasting_types, motion_sums, with_evidence
from contactgraph.model.types import EncodedGraph
from contactgraph.train.batch import Window
from contactgraph.train.judged_steps import without_gradient
from contactgraph.train.loss import LossTerms, WindowSteps, masked_mean

_PRIOR_WEIGHT = 0.1


def typical_distance(dataset: Dataset) -> float:
    """Median distance of two bodies over all pairs and states, m: a unit for force laws."""
    found = []
    for each in dataset:
        first, second = np.triu_indices(each.scene.node_count, 1)
        apart = each.position[:, first] - each.position[:, second]
        found.append(np.linalg.norm(apart, axis=-1).ravel())
    distance = np.concatenate(found)
    return float(np.median(distance)) if distance.size else 1.0


def relation_loss(
    model: ContactDynamics, trajectories: Window, step_mask: Bool[Array, "B T"]
) -> LossTerms:
    """`LossTerms.likelihood` alone; ``trajectories`` are whole ones, real in the masked steps."""
    graph, effects, residual = _evidence(model, trajectories, step_mask)
    known = jax.lax.stop_gradient((graph, effects, residual))
    belief = jax.vmap(lasting_types)(_posterior(without_gradient(model), *known))
    active = model.inference.edge_types - 1
    p = belief[:, :, 1:]
    moved = effects.reshape(*effects.shape[:-1], -1, active)
    expected = jnp.einsum("btndea,bea->btnde", moved, p)
    spread = jnp.einsum("btndea,bea->btnde", moved**2, p) - expected**2
    error = (residual - jnp.sum(expected, -1)) ** 2 + jnp.sum(spread, -1)
    local = model.local_dynamics
    assert isinstance(local, RelationDynamics)
    noise = local.noise(jax.lax.stop_gradient(effects))[..., None]
    score = 0.5 * error / noise**2 + jnp.log(noise)
    real = (step_mask[:, :, None] & trajectories.learned[:, None])[..., None]
    log_prior = graph.embedding[:, 0, :, : active + 1]
    surprise = -jnp.sum(belief * log_prior, axis=-1)
    zero = jnp.zeros(())
    return LossTerms(
        prediction=zero,
        squared=zero,
        rollout=zero,
        prior=zero,
        likelihood=masked_mean(score, jnp.broadcast_to(real, score.shape))
        + _PRIOR_WEIGHT * masked_mean(surprise, graph.weight[:, 0] > 0),
        noise=zero,
    )


def related_beliefs(model: ContactDynamics, windows: Window) -> ContactBelief:
    """The beliefs in the last states of windows, by the motion of every step."""
    always = jnp.ones(windows.control.shape[:2], bool)
    graph, effects, residual = _evidence(model, windows, always)
    return _posterior(model, graph, effects, residual)


def _evidence(
    model: ContactDynamics, windows: Window, step_mask: Bool[Array, "B T"]
) -> tuple[EncodedGraph, Float[Array, "B T N D Z"], Float[Array, "B T N D"]]:
    """The graph of every step, and `RelationDynamics.evidence`, 0 where a step is not real."""
    steps = WindowSteps(model, windows, 1)
    graph = steps.encode(None)
    local = model.local_dynamics
    assert isinstance(local, RelationDynamics)

    def of_step(graph: EncodedGraph, control: Array, after: Array) -> tuple[Array, Array]:
        free = model.cut_edges(graph, ContactBelief(graph.prior))
        return local.evidence(free, model.dt, control, after)

    effects, residual = steps.each(of_step, graph, windows.control, windows.velocity[:, 1:])
    real = step_mask[:, :, None, None]
    return graph, jnp.where(real[..., None], effects, 0.0), jnp.where(real, residual, 0.0)


def _posterior(
    model: ContactDynamics, graph: EncodedGraph, effects: Array, residual: Array
) -> ContactBelief:
    inference, local = model.inference, model.local_dynamics
    assert isinstance(inference, StaticEdges) and isinstance(local, RelationDynamics)

    def along(prior: Array, effects: Array, residual: Array) -> ContactBelief:
        sums = motion_sums(effects, residual, local.noise(effects))
        return with_evidence(inference.first_belief(prior), *sums)

    return jax.vmap(along)(graph.embedding[:, 0], effects, residual)
