"""Inference of active edges, in five interchangeable forms.

Each has ``embed`` (one step's graph to edge embeddings, independent of time) and ``predict``
(belief about the last step, an embedding and the geometric prior to the belief about the next one).
The split keeps the expensive part out of the loop over time. Another recurrent cell is another
class with these two methods and a field ``edge_types``: see ``examples/extend_recurrent_cell.py``.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.model.contact_belief import ContactBelief, bounded_softmax, kept_share
from contactgraph.model.message_passing import EdgeNetwork, MessagePassing

_MEMORY = 8
"""Size of an edge's clock."""
_MIN_PRIOR = 1e-6
_AGES = np.array([*range(1, 13), 15, 19, 24, 30, 37, 46, 58]) - 0.5
"""Ages, in steps, that the rates are told to be exceeded or not: a duration may be exact."""
_BLIND = 5.0
"""Steps without observation for which the input of the rates is one half."""


class TransitionEdges(eqx.Module):
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
    edge_types: int = eqx.field(static=True)
    node_types: int = eqx.field(static=True)
    memory_size: int = eqx.field(static=True)
    commands: int = eqx.field(static=True)
    """Components of the control that are features of the edges of actuated nodes."""
    min_transition: float = eqx.field(static=True)
    """Least probability of any transition in a step: no type is certain to last, or to change."""

    def __init__(
        self,
        message_passing: EdgeNetwork,
        *,
        node_types: int,
        edge_types: int = 2,
        memory_size: int = _MEMORY,
        commands: int = 0,
        min_transition: float = 2e-3,
        key: PRNGKeyArray,
    ):
        """``message_passing`` takes features, stillness, `commands` and `node_types` counts."""
        cell_key, rate_key = jax.random.split(key)
        width = message_passing.width
        self.message_passing = message_passing
        self.cell = eqx.nn.GRUCell(edge_types, memory_size, key=cell_key)
        known = width + memory_size + (edge_types - 1) * len(_AGES) + 1 + edge_types
        rates = eqx.nn.MLP(known, edge_types**2, width, 1, key=rate_key)
        last = rates.layers[-1]
        assert last.bias is not None
        self.rates = eqx.tree_at(
            lambda mlp: (mlp.layers[-1].weight, mlp.layers[-1].bias),
            rates,
            (0.0 * last.weight, 0.0 * last.bias),
        )
        self.edge_types = edge_types
        self.node_types = node_types
        self.memory_size = memory_size
        self.commands = commands
        self.min_transition = min_transition

    @property
    def carried_size(self) -> int:
        """Size of `ContactBelief.memory`: steps unobserved, hidden state, ages."""
        return self.memory_size + self.edge_types

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

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> ContactBelief:
        """The belief about the next step, and its clock."""
        return self.predict_joint(belief, embedding, prior)[0]

    def predict_joint(
        self, belief: ContactBelief, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The same, and the probability of each pair of types before and after."""
        before, clock = belief.type_probability, belief.memory
        assert clock is not None, "a belief of this inference has a clock"
        unobserved, hidden, age = jnp.split(clock, [1, 1 + self.memory_size], axis=-1)
        hidden = jax.vmap(self.cell)(before, hidden)
        ages = jnp.tile(jnp.asarray(_AGES, age.dtype), self.edge_types - 1)
        exceeded = jax.nn.sigmoid(4.0 * (jnp.repeat(age, len(_AGES), axis=-1) - ages))
        blind = unobserved / (unobserved + _BLIND)
        known = jnp.concatenate([embedding, hidden, exceeded, blind, blind * before], axis=-1)
        rates = jax.vmap(self.rates)(known).reshape(-1, self.edge_types, self.edge_types)
        logits = jnp.log(jnp.maximum(prior, _MIN_PRIOR))[:, None, :] + rates
        joint = before[:, :, None] * bounded_softmax(logits, self.min_transition)
        memory = jnp.concatenate([unobserved + 1.0, hidden, 1.0 + age * kept_share(joint)], axis=-1)
        return ContactBelief(jnp.sum(joint, axis=1), belief.edge_id, memory), joint


class RecurrentEdges(eqx.Module):
    """Messages in space, then one gated recurrent cell per edge in time (the paper's GIM-Temp).

    The belief itself is the recurrent state, so a corrected belief changes later predictions.
    """

    message_passing: MessagePassing | EdgeNetwork
    input: eqx.nn.Linear
    hidden: eqx.nn.Linear
    edge_types: int = eqx.field(static=True)
    temperature: float = eqx.field(static=True)

    def __init__(
        self,
        message_passing: MessagePassing | EdgeNetwork,
        *,
        edge_types: int = 2,
        temperature: float = 0.15,
        key: PRNGKeyArray,
    ):
        """`temperature` divides the cell's state before the softmax; at 1 no edge is certain."""
        keys = jax.random.split(key)
        self.message_passing = message_passing
        self.input = eqx.nn.Linear(message_passing.width, 3 * edge_types, key=keys[0])
        self.hidden = eqx.nn.Linear(edge_types, 3 * edge_types, key=keys[1])
        self.edge_types = edge_types
        self.temperature = temperature

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> Float[Array, "E M"]:
        """Input of the recurrent cell, for every edge of one step's graph."""
        return _edge_embedding(self.message_passing, self.input, node, edge, weight, edge_index)

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> ContactBelief:
        """The belief about the next step."""
        state = belief.type_probability
        reset_in, update_in, new_in = jnp.split(embedding, 3, axis=-1)
        mixed = jax.vmap(self.hidden)(state)
        reset_mixed, update_mixed, new_mixed = jnp.split(mixed, 3, axis=-1)
        reset = jax.nn.sigmoid(reset_in + reset_mixed)
        update = jax.nn.sigmoid(update_in + update_mixed)
        new = jnp.tanh(new_in + reset * new_mixed)
        state = (1.0 - update) * new + update * state
        return ContactBelief(jax.nn.softmax(state / self.temperature, axis=-1))


class MemorylessEdges(eqx.Module):
    """Messages in space only, without memory (the paper's GIM-Non-Temp)."""

    message_passing: MessagePassing | EdgeNetwork
    output: eqx.nn.Linear
    edge_types: int = eqx.field(static=True)

    def __init__(
        self,
        message_passing: MessagePassing | EdgeNetwork,
        *,
        edge_types: int = 2,
        key: PRNGKeyArray,
    ):
        self.message_passing = message_passing
        self.output = eqx.nn.Linear(message_passing.width, edge_types, key=key)
        self.edge_types = edge_types

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> Float[Array, "E K"]:
        """Scores of the edge types, for every edge of one step's graph."""
        return _edge_embedding(self.message_passing, self.output, node, edge, weight, edge_index)

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E K"], prior: Float[Array, "E K"]
    ) -> ContactBelief:
        """The belief about the next step, independent of the old one."""
        return ContactBelief(jax.nn.softmax(embedding, axis=-1))


class _WithoutMessages(eqx.Module):
    edge_types: int = eqx.field(static=True, default=2)

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> Float[Array, "E 0"]:
        """Nothing to embed."""
        return jnp.zeros((weight.shape[0], 0), node.dtype)


class AllEdges(_WithoutMessages):
    """Every edge active at every step (the paper's No-GIM)."""

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E 0"], prior: Float[Array, "E K"]
    ) -> ContactBelief:
        """Certainty that every edge is active (of the first active type)."""
        certain = jnp.zeros_like(belief.type_probability).at[..., 1].set(1.0)
        return ContactBelief(certain)


class PriorEdges(_WithoutMessages):
    """The geometric prior alone, as an ablation of inference: no belief survives a step.

    The prior knows no types, so all of its active part is of one. Corrections still apply to the
    step just made.
    """

    active_type: int = eqx.field(static=True, default=1)
    carried_size: int = eqx.field(static=True, default=1)
    """Of a memory that stays 0. Without a memory the correction by motion would have its own."""

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E 0"], prior: Float[Array, "E K"]
    ) -> ContactBelief:
        """The prior, independent of the old belief."""
        active = jnp.sum(prior[:, 1:], axis=-1)
        types = jnp.zeros_like(prior).at[:, 0].set(prior[:, 0])
        types = types.at[:, self.active_type].set(active)
        memory = jnp.zeros((prior.shape[0], self.carried_size), prior.dtype)
        return ContactBelief(types, belief.edge_id, memory)


def _edge_embedding(
    message_passing: MessagePassing | EdgeNetwork,
    output: eqx.nn.Linear,
    node: Float[Array, "N F"],
    edge: Float[Array, "2 E G"],
    weight: Float[Array, " E"],
    edge_index: Int[Array, "2 E"],
) -> Float[Array, "E out"]:
    _, message = message_passing(node, edge, weight, edge_index)
    # Contact is symmetric: the two directions are summed before anything is decided.
    return jax.vmap(output)(message[0] + message[1])


EdgeInference = TransitionEdges | RecurrentEdges | MemorylessEdges | AllEdges | PriorEdges
