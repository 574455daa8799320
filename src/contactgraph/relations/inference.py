r"""Inference of relations that never change: all that a trajectory shows, by Bayes' rule.

Relations couple bodies, so the motion of a step speaks about all edges of a body at once. But the
velocity that it leads to is linear in the edge types z, one-hot:

$$ v' = v'_0 + \Phi z + \epsilon, \qquad \epsilon \sim N(0, \sigma^2), $$

and the evidence of all steps is two sums, $G = \sum \Phi^\top \Phi / \sigma^2$ and
$b = \sum \Phi^\top (v' - v'_0) / \sigma^2$:

$$ \log p(z \mid \text{motion}) = \log p(z) + b^\top z - \tfrac12 z^\top G z + \text{const}. $$

Their factors are found by mean field, one edge at a time given the beliefs about all others, from
the least-squares solution on. A belief carries the sums (`MotionSums`), so that nothing that was
seen is forgotten and no decision of an early step binds a later one. Its probabilities are those of
types that act at the present distance.
"""

import dataclasses
from typing import Any, Self, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from contactgraph.bodies.graph import HOLD, EdgeType
from contactgraph.inference.contact_belief import ContactBelief, EdgeMemory, without_change
from contactgraph.inference.edge_inference import EdgeInference

_SWEEPS = 8
_LEAST = 1e-6
"""Least probability of a type, so that a sensor's report can still change it."""


class StaticEdges(EdgeInference):
    """Edges that keep their types for a whole trajectory, with a prior by the types of the ends.

    The prior is learned, independent of the geometry, and starts as 1/2 for *inactive*.
    """

    log_prior: Float[Array, "node_types node_types K"]
    node_types: int = eqx.field(static=True)
    edge_types: tuple[EdgeType, ...] = eqx.field(static=True)

    def __init__(self, node_types: int, edge_types: tuple[EdgeType, ...] = (HOLD,)):
        first = np.log([0.5, *[0.5 / len(edge_types)] * len(edge_types)])
        self.log_prior = jnp.broadcast_to(jnp.asarray(first), (node_types, node_types, len(first)))
        self.node_types = node_types
        self.edge_types = edge_types

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
        **step: Any,
    ) -> Float[Array, "E K"]:
        """The logarithm of every edge's prior, by the types of its ends alone.

        They come first in ``node``. `RelationModel.encode` adds which types are within range.
        """
        first, second = node[edge_index, : self.node_types]
        both = self.log_prior + jnp.swapaxes(self.log_prior, 0, 1)
        log_prior = jax.nn.log_softmax(0.5 * jnp.einsum("ei,ej,ijk->ek", first, second, both))
        absent = jnp.log(jnp.full_like(log_prior[:1], _LEAST).at[:, 0].set(1.0))
        return jnp.where(weight[:, None] > 0, log_prior, absent)

    def init(
        self, embedding: Float[Array, "E K+active"], prior: Float[Array, "E K"]
    ) -> ContactBelief:
        """The belief before the first observation, with sums of 0."""
        log_prior, acts = jnp.split(embedding, [1 + len(self.edge_types)], axis=-1)
        edges, active = acts.shape
        b, G = jnp.zeros_like(acts), jnp.zeros((edges, edges * active**2), acts.dtype)
        return MotionSums(log_prior, log_prior, acts, b, G).belief()

    def predict(
        self,
        belief: ContactBelief,
        embedding: Float[Array, "E K+active"],
        prior: Float[Array, "E K"],
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The belief about the next step: relations last, and act within their range."""
        acts = embedding[:, 1 + len(self.edge_types) :]
        return without_change(dataclasses.replace(_sums(belief), acts=acts).belief())


def motion_sums(
    effects: Float[Array, "*T N D Z"], residual: Float[Array, "*T N D"], noise: Float[Array, "*T N"]
) -> tuple[Float[Array, "Z Z"], Float[Array, " Z"]]:
    """G and b of steps; ``residual`` [m/s]: observed velocity less that without any edge."""
    Phi = (effects / noise[..., None, None]).reshape(-1, effects.shape[-1])
    return Phi.T @ Phi, Phi.T @ (residual / noise[..., None]).ravel()


def edge_posterior(
    log_prior: Float[Array, "E K"], G: Float[Array, "Z Z"], b: Float[Array, " Z"]
) -> Float[Array, "E K"]:
    """The factors of p(z | motion), one for each edge; Z is E times the K - 1 active types."""
    edges, types = log_prior.shape
    active = types - 1
    prior = jnp.exp(log_prior)[:, 1:].ravel()
    precision = 1.0 / jnp.maximum(prior * (1.0 - prior), _LEAST)
    relaxed = jnp.linalg.solve(G + jnp.diag(precision), b + precision * prior)
    q = jnp.clip(relaxed, 0.0, 1.0).reshape(edges, active)
    q = q / jnp.maximum(jnp.sum(q, axis=-1, keepdims=True), 1.0)
    rows = G.reshape(edges, active, edges, active)
    own = jnp.einsum("eaeb->eab", rows)
    pull = b.reshape(edges, active) - 0.5 * jnp.einsum("eaa->ea", own)

    def visit(q: Array, edge: Array) -> tuple[Array, None]:
        others = jnp.einsum("afb,fb->a", rows[edge], q) - own[edge] @ q[edge]
        scores = log_prior[edge].at[1:].add(pull[edge] - others)
        return q.at[edge].set(jax.nn.softmax(scores)[1:]), None

    q = jax.lax.scan(visit, q, jnp.tile(jnp.arange(edges), _SWEEPS))[0]
    types_of = jnp.concatenate([1.0 - jnp.sum(q, axis=-1, keepdims=True), q], axis=-1)
    types_of = jnp.maximum(types_of, _LEAST)
    return types_of / jnp.sum(types_of, axis=-1, keepdims=True)


class MotionSums(EdgeMemory):
    """Memory of `StaticEdges`."""

    log_prior: Float[Array, "*T E K"]
    """With all that was reported by sensors."""
    log_types: Float[Array, "*T E K"]
    """Posterior of the types, whether they act or not."""
    acts: Float[Array, "*T E active"]
    """1 where a type acts at the present distance, else 0."""
    b: Float[Array, "*T E active"]
    G: Float[Array, "*T E E*active^2"]

    def after_report(self, before: Float[Array, "*T E K"], after: Float[Array, "*T E K"]) -> Self:
        """A report joins the prior."""
        change = jnp.log(jnp.maximum(after, _LEAST)) - jnp.log(jnp.maximum(before, _LEAST))
        normal = jax.nn.log_softmax
        return dataclasses.replace(
            self,
            log_prior=normal(self.log_prior + change),
            log_types=normal(self.log_types + change),
        )

    def belief(self) -> ContactBelief:
        """The belief that carries this: probability of the types that act."""
        active = jnp.exp(self.log_types[:, 1:]) * self.acts
        inactive = 1.0 - jnp.sum(active, axis=-1, keepdims=True)
        return ContactBelief(jnp.concatenate([inactive, active], axis=-1), memory=self)


def _sums(belief: ContactBelief) -> MotionSums:
    return cast(MotionSums, belief.memory)


def with_evidence(
    belief: ContactBelief, G: Float[Array, "Z Z"], b: Float[Array, " Z"]
) -> ContactBelief:
    """The belief after further steps, of which G and b are the sums."""
    seen = _sums(belief)
    b, G = seen.b.ravel() + b, seen.G.reshape(G.shape) + G
    log_types = jnp.log(edge_posterior(seen.log_prior, G, b))
    b, G = b.reshape(seen.b.shape), G.reshape(seen.G.shape)
    return dataclasses.replace(seen, log_types=log_types, b=b, G=G).belief()


def lasting_types(belief: ContactBelief) -> Float[Array, "E K"]:
    """Probability of the types of edges, also of those out of their range at present."""
    return jnp.exp(_sums(belief).log_types)
