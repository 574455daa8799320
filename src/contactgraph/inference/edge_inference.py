"""Inference of active edges: their prior and weight by distance, and beliefs from step to step."""

import dataclasses
import math
from abc import abstractmethod
from typing import Self, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from contactgraph.bodies.geometry import Geometry
from contactgraph.bodies.graph import HOLD, EdgeType
from contactgraph.bodies.message_passing import EdgeNetwork, MessagePassing
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.inference.contact_belief import ContactBelief, EdgeMemory
from contactgraph.inference.features import with_commands

_MEMORY = 8
"""Size of an edge's clock."""
_MIN_PROBABILITY = 1e-6
_UNBOUNDED = 0.1
"""Share of the gradient that is kept beyond the least transition."""
_AGES = np.array([*range(1, 13), 15, 19, 24, 30, 37, 46, 58]) - 0.5
"""Ages, in steps, that the rates are told to be exceeded or not: a duration may be exact."""
_BLIND = 5.0
"""Steps without observation for which the input of the rates is one half."""


class ClosestApproachPrior(eqx.Module):
    r"""Probability of contact from the closest approach of two nodes within the step.

    $$ q = \epsilon + (1 - 2 \epsilon)\, \sigma\big( 2 (m \rho - d) / (s \rho) \big) $$

    with $\rho$ the contact distance, which the model learns from impacts, and $d$ the distance of
    closest approach in the next step: the edge of a step must already be active when bodies touch
    *within* it. No gradient flows to $\rho$. The prior is never more certain than $\epsilon$,
    because an unknown force may bring bodies together or keep them apart.
    """

    margin: float = eqx.field(static=True, default=1.03)
    """$m$; factor on the contact distance below which nodes count as touching."""
    sharpness: float = eqx.field(static=True, default=0.02)
    """$s$."""
    min_probability: float = eqx.field(static=True, default=0.01)
    r"""$\epsilon$."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Prior probability that each edge is active."""
        touch = jax.lax.stop_gradient(geometry.contact_distance)
        margin = (self.margin * touch - geometry.closest_approach) / (self.sharpness * touch)
        spread = 1.0 - 2.0 * self.min_probability
        return self.min_probability + spread * jax.nn.sigmoid(2.0 * margin)


class SmoothCutoff(eqx.Module):
    """Weight of an edge by distance: 1 below `inner` [m], exactly 0 from `outer` [m] on.

    A node beyond the cutoff of all others changes no prediction of theirs, exactly.
    """

    inner: float = eqx.field(static=True, default=0.15)
    outer: float = eqx.field(static=True, default=0.25)

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight of each edge in [0, 1], by its closest approach in the step."""
        fraction = (self.outer - geometry.closest_approach) / (self.outer - self.inner)
        fraction = jnp.clip(fraction, 0.0, 1.0)
        return fraction**2 * (3.0 - 2.0 * fraction)


class NoCutoff(eqx.Module):
    """Weight 1 at every distance: the paper's all-pairs inference."""

    outer: float = eqx.field(static=True, default=math.inf)
    """m"""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight 1 for every edge."""
        return jnp.ones_like(geometry.distance)


class EdgeInference(eqx.Module):
    """Beliefs about the types of edges, from step to step.

    ``embed`` turns one step's graph into edge embeddings, independent of time; ``predict`` turns
    the belief about the last step, an embedding and the geometric prior into the belief about the
    next one. The split keeps the expensive part out of the loop over time. Another recurrent cell
    is another class with these two methods and a field ``edge_types``: see
    ``examples/extend_recurrent_cell.py``. All else has a default.
    """

    edge_types: eqx.AbstractVar[tuple[EdgeType, ...]]
    """The active types."""
    commands: int = eqx.field(static=True, default=0, kw_only=True)
    """Last components of the control that are features of the edges of actuated nodes."""

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> Float[Array, "E M"]:
        """What one step's graph tells about every edge, by default nothing; ``edge`` are
        `edge_inputs`."""
        return jnp.zeros((weight.shape[0], 0), node.dtype)

    @abstractmethod
    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The belief about the next step, and the probability of each pair of types before and
        after; `without_change` makes these of a belief alone."""

    def init(self, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]) -> ContactBelief:
        """The belief before the first observation: by default the geometric prior."""
        return ContactBelief(prior, edge_types=self.edge_types)

    @property
    def networks(self) -> list[MessagePassing | EdgeNetwork]:
        """Those whose messages decide about edges."""
        return []

    def edge_inputs(
        self,
        features: Float[Array, "2 E F"],
        geometry: Geometry,
        nodes: Nodes,
        command: Float[Array, " U"],
    ) -> Float[Array, "2 E G"]:
        """What `embed` is given of every edge: by default the model's edge ``features`` alone."""
        return features


class EdgeClock(EdgeMemory):
    """Memory of `TransitionEdges`."""

    unobserved: Float[Array, "*T E 1"]
    """Steps since the bodies were observed."""
    hidden: Float[Array, "*T E H"]
    """State of the gated cell."""
    age: Float[Array, "*T E active"]
    """Expected number of steps for which an edge has had each active type if it has it."""

    @property
    def observed(self) -> Self:
        """That of edges whose bodies have just been observed."""
        return dataclasses.replace(self, unobserved=jnp.zeros_like(self.unobserved))

    def after_motion(
        self,
        joint: Float[Array, "E K K"],
        posterior: Float[Array, "E K K"],
        evidence: Bool[Array, "E 1"],
    ) -> Self:
        """Motion that speaks for a change makes an age small."""
        kept = _kept_share(posterior) / jnp.maximum(_kept_share(joint), _MIN_PROBABILITY)
        age = jnp.where(evidence, 1.0 + (self.age - 1.0) * kept, self.age)
        return dataclasses.replace(self, age=age.astype(self.age.dtype))


class TransitionEdges(EdgeInference):
    r"""A hidden Markov filter for every edge, with learned transitions and a clock.

    With the geometric prior q of the step, features f of the edge and the clock h,

    $$ h' = \mathrm{GRU}(p, h), \quad
       T_{ij} = \mathrm{softmax}_j(\log q_j + r_{ij}([f, h', a])), \quad p' = p\,T, \quad
       a'_j = 1 + a_j\,p_j T_{jj} / p'_j, $$

    and every T is at least `min_transition`. The age a is the expected number of steps for which an
    edge has had each active type if it has it, so that contacts may last for characteristic times;
    told that of *free*, the rates would take an unusual one for a denied contact. The belief p is
    the corrected one, so evidence lasts until something speaks against it. The rates are told for
    how many steps the state has not been observed: it has followed the likeliest types since, so
    that its geometry does not fit the others. They start at 0, where p' = q. Features are the
    edge's own and the types of its ends; observed velocities enter only through the correction.
    """

    message_passing: EdgeNetwork
    cell: eqx.nn.GRUCell
    rates: eqx.nn.MLP
    edge_types: tuple[EdgeType, ...] = eqx.field(static=True)
    node_types: int = eqx.field(static=True)
    memory_size: int = eqx.field(static=True)
    min_transition: float = eqx.field(static=True)
    """Least probability of any transition in a step: no type is certain to last, or to change."""

    def __init__(
        self,
        message_passing: EdgeNetwork,
        *,
        node_types: int,
        edge_types: tuple[EdgeType, ...] = (HOLD,),
        memory_size: int = _MEMORY,
        commands: int = 0,
        min_transition: float = 2e-3,
        key: PRNGKeyArray,
    ):
        """``message_passing`` takes features, stillness, `commands` and `node_types` counts."""
        cell_key, rate_key = jax.random.split(key)
        width, count = message_passing.width, 1 + len(edge_types)
        self.message_passing = message_passing
        self.cell = eqx.nn.GRUCell(count, memory_size, key=cell_key)
        known = width + memory_size + len(edge_types) * len(_AGES) + 1 + count
        rates = eqx.nn.MLP(known, count**2, width, 1, key=rate_key)
        self.rates = eqx.tree_at(
            lambda mlp: (mlp.layers[-1].weight, mlp.layers[-1].bias),
            rates,
            replace_fn=jnp.zeros_like,
        )
        self.edge_types = edge_types
        self.node_types = node_types
        self.memory_size = memory_size
        self.commands = commands
        self.min_transition = min_transition

    @property
    def networks(self) -> list[MessagePassing | EdgeNetwork]:
        """Those whose messages decide about edges."""
        return [self.message_passing]

    def edge_inputs(
        self,
        features: Float[Array, "2 E F"],
        geometry: Geometry,
        nodes: Nodes,
        command: Float[Array, " U"],
    ) -> Float[Array, "2 E G"]:
        """The model's edge features, stillness, and the commands on actuated ends."""
        return with_commands(features, geometry, nodes, command[len(command) - self.commands :])

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> Float[Array, "E M"]:
        """Features of every edge of one step's graph; the types come first in ``node``."""
        ends = jnp.sum(node[edge_index, : self.node_types], axis=0)
        known = jnp.concatenate([edge, jnp.broadcast_to(ends, (2, *ends.shape))], axis=-1)
        _, message = self.message_passing(node, known, weight, edge_index)
        # Unbounded, it grows a thousandfold in training, and the rates with it.
        return message[0] / jnp.sqrt(1.0 + jnp.mean(message[0] ** 2, axis=-1, keepdims=True))

    def init(self, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]) -> ContactBelief:
        """The geometric prior, with a clock that has not run."""
        edges, types = prior.shape
        sizes = 1, self.memory_size, types - 1
        clock = EdgeClock(*(jnp.zeros((edges, size), prior.dtype) for size in sizes))
        return ContactBelief(prior, memory=clock, edge_types=self.edge_types)

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The belief about the next step with its clock, and the probability of pairs of types."""
        before, clock = belief.type_probability, cast(EdgeClock, belief.memory)
        unobserved, age = clock.unobserved, clock.age
        hidden = jax.vmap(self.cell)(before, clock.hidden)
        ages = jnp.tile(jnp.asarray(_AGES, age.dtype), len(self.edge_types))
        exceeded = jax.nn.sigmoid(4.0 * (jnp.repeat(age, len(_AGES), axis=-1) - ages))
        blind = unobserved / (unobserved + _BLIND)
        known = jnp.concatenate([embedding, hidden, exceeded, blind, blind * before], axis=-1)
        rates = jax.vmap(self.rates)(known).reshape(*before.shape, before.shape[-1])
        logits = jnp.log(jnp.maximum(prior, _MIN_PROBABILITY))[:, None, :] + rates
        joint = before[:, :, None] * _bounded_softmax(logits, self.min_transition)
        clock = EdgeClock(unobserved + 1.0, hidden, 1.0 + age * _kept_share(joint))
        after = jnp.sum(joint, axis=1)
        return ContactBelief(after, memory=clock, edge_types=self.edge_types), joint


def _bounded_softmax(logits: Float[Array, "E K K"], least: float) -> Float[Array, "E K K"]:
    """Softmax, at least ``least``; a part of its gradient is that without the bound.

    Beyond the bound logits have no effect, and without any gradient they would never return.
    """
    unbounded = jax.nn.log_softmax(logits)
    bounded = least + (1.0 - logits.shape[-1] * least) * jnp.exp(unbounded)
    return bounded * jnp.exp(_UNBOUNDED * (unbounded - jax.lax.stop_gradient(unbounded)))


def _kept_share(joint: Float[Array, "E K K"]) -> Float[Array, "E active"]:
    """Probability that an edge had an active type before, too, if it has it now.

    No gradient is taken: that of improbable types has no bound.
    """
    joint = jax.lax.stop_gradient(joint)
    kept = jnp.einsum("eii->ei", joint)
    return (kept / jnp.maximum(jnp.sum(joint, axis=1), _MIN_PROBABILITY))[:, 1:]


class PriorEdges(EdgeInference):
    """The geometric prior alone, as an ablation of inference: no belief survives a step.

    The prior knows no types, so all of its active part is of one. Corrections still apply to the
    step just made. With ``least`` 1 every edge is active at every step (the paper's No-GIM).
    """

    edge_types: tuple[EdgeType, ...] = eqx.field(static=True, default=(HOLD,))
    active_type: int = eqx.field(static=True, default=1)
    least: float = eqx.field(static=True, default=0.0)
    """Probability that an edge is active whatever its prior."""

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E 0"], prior: Float[Array, "E K"]
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The prior; pairs of equal types, none of which motion makes possible if it is not."""
        active = self.least + (1.0 - self.least) * jnp.sum(prior[:, 1:], axis=-1)
        types = jnp.zeros_like(prior).at[:, 0].set((1.0 - self.least) * prior[:, 0])
        types = types.at[:, self.active_type].set(active)
        joint = types[:, :, None] * jnp.eye(types.shape[-1], dtype=types.dtype)
        return ContactBelief(types, edge_types=self.edge_types), joint
