r"""Which relations hold, when they never change: all that a trajectory shows, by Bayes' rule.

Relations couple bodies, so the motion of a step speaks about all edges of a body at once. But the
velocity that it leads to is linear in the edge types z, one-hot:

.. math:: v' = v'_0 + \Phi z + \epsilon, \qquad \epsilon \sim N(0, \sigma^2),

and the evidence of all steps is two sums, :math:`G = \sum \Phi^\top \Phi / \sigma^2` and
:math:`b = \sum \Phi^\top (v' - v'_0) / \sigma^2`:

.. math:: \log p(z \mid \text{motion}) = \log p(z) + b^\top z - \tfrac12 z^\top G z + \text{const}.

Their factors are found by mean field, one edge at a time given the beliefs about all others, from
the least-squares solution on. A belief carries the sums (`ContactBelief.memory`), so that nothing
that was seen is forgotten and no decision of an early step binds a later one.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from contactgraph.model.contact_belief import ContactBelief

_SWEEPS = 8
_LEAST = 1e-6
"""Least probability of a type, so that a sensor's report can still change it."""


class StaticEdges(eqx.Module):
    """Edges that keep their types for a whole trajectory, with a prior by the types of the ends.

    The prior is learned, independent of the geometry, and starts as 1/2 for *inactive*.
    """

    log_prior: Float[Array, "node_types node_types K"]
    node_types: int = eqx.field(static=True)
    edge_types: int = eqx.field(static=True)

    def __init__(self, node_types: int, edge_types: int = 2):
        first = np.log([0.5, *[0.5 / (edge_types - 1)] * (edge_types - 1)])
        self.log_prior = jnp.broadcast_to(jnp.asarray(first), (node_types, node_types, edge_types))
        self.node_types = node_types
        self.edge_types = edge_types

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> Float[Array, "E K"]:
        """The logarithm of every edge's prior; the types come first in ``node``."""
        first, second = node[edge_index, : self.node_types]
        both = self.log_prior + jnp.swapaxes(self.log_prior, 0, 1)
        return jax.nn.log_softmax(0.5 * jnp.einsum("ei,ej,ijk->ek", first, second, both))

    def first_belief(self, embedding: Float[Array, "E K"]) -> ContactBelief:
        """The belief before the first observation, with sums of 0."""
        edges, types = embedding.shape
        sums = jnp.zeros((edges, (types - 1) * (edges * (types - 1) + 1)), embedding.dtype)
        unseen = jnp.zeros_like(embedding[:, :1])
        memory = jnp.concatenate([unseen, embedding, embedding, sums], axis=-1)
        return ContactBelief(jnp.exp(embedding), None, memory)

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E K"], prior: Float[Array, "E K"]
    ) -> ContactBelief:
        """The same belief: relations last."""
        return belief


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
    return jnp.clip(types_of, _LEAST, 1.0)


def with_evidence(
    belief: ContactBelief, G: Float[Array, "Z Z"], b: Float[Array, " Z"]
) -> ContactBelief:
    """The belief after further steps, of which G and b are the sums.

    What has changed the types since the last steps, such as a sensor's report, joins the prior.
    """
    assert belief.memory is not None, "a belief of this inference carries sums"
    edges, types = belief.type_probability.shape
    active = types - 1
    unseen, prior, last, old_b, old_G = jnp.split(
        belief.memory, np.cumsum([1, types, types, active]), axis=-1
    )
    now = jnp.log(jnp.maximum(belief.type_probability, _LEAST))
    prior = jax.nn.log_softmax(prior + now - last)
    b = old_b.ravel() + b
    G = old_G.reshape(edges * active, edges * active) + G
    after = edge_posterior(prior, G, b)
    kept = [unseen, prior, jnp.log(after), b.reshape(edges, active), G.reshape(edges, -1)]
    return ContactBelief(after, belief.edge_id, jnp.concatenate(kept, axis=-1))
