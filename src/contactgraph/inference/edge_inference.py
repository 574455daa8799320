"""Inference of active edges: beliefs about their types from step to step."""

import dataclasses
from abc import abstractmethod
from functools import partial
from typing import Any, Self, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.graph import HOLD, EdgeType
from contactgraph.bodies.message_passing import EdgeNetwork, MessagePassing
from contactgraph.inference.contact_belief import ContactBelief, EdgeMemory
from contactgraph.inference.features import GAP_SCALES, pull_approach_gap_and_switches

_AGES = 44
"""Ages that are told apart, in steps; the last stands for all longer ones."""
_PACE = 10.0
"""Scale of the log odds by age in their parameters, so that they learn as fast as networks."""
_LASTS, _BEGINS = 5.0, -3.0
"""Log odds, beside those of geometry, that what holds lasts, and that a hold begins, before
training."""
_DISTANT = 10.0
"""Log odds by which bodies far from each other hold less, before training."""
_TOUCHES, _STAYS_FREE = 3.0, 10.0
"""Log odds, beside those of geometry, that a touch of bodies without a gap lasts, and that such
bodies which are free stay so while they do not approach each other. They are not learned: motion
hardly tells a touch from none."""
_SURE = 20.0
"""Log odds that count as certain, either way; gradients of products of more overflow."""
_MIN_PROBABILITY, _SMALLEST = 1e-6, 1e-24


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
        **step: Any,
    ) -> Float[Array, "E M"]:
        """What one step's graph tells about every edge, by default nothing.

        ``step`` has its ``geometry``, ``nodes``, ``control`` [U] and, where known, ``displacement``
        [N, D] m by the control alone, as if nothing held: a belief is no evidence of itself.
        """
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

    def table(self, belief: ContactBelief) -> Float[Array, "E K A"]:
        """The probability of each type and age; by default there are no ages."""
        return belief.type_probability[..., None]

    def parted(
        self, table: Float[Array, "E K A"], embedding: Float[Array, "E M"]
    ) -> Float[Array, "E K A"]:
        """The table before a step, linear in that after the last one: by default the same."""
        return table

    def transitions(
        self, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> Float[Array, "E K A K"]:
        """The probability of each type after a step, given type and age before it: by default that
        which `predict` has for a first belief."""

        def from_type(types: Float[Array, " K"]) -> Float[Array, "E K"]:
            belief = self.init(embedding, jnp.broadcast_to(types, prior.shape))
            return self.predict(belief, embedding, prior)[0].type_probability

        every = jnp.eye(prior.shape[-1], dtype=prior.dtype)
        return jax.vmap(from_type, out_axes=1)(every)[:, :, None]

    @property
    def networks(self) -> list[MessagePassing | EdgeNetwork]:
        """Those whose messages decide about edges."""
        return []


class EdgeAges(EdgeMemory):
    """For how many steps the edges have had their types."""

    age: Float[Array, "*T E K A"]
    """Probability of each age if an edge has the type, 0 where nothing is known of it: then what is
    free has been so for long, and what is active has just begun."""

    def after_motion(
        self,
        joint: Float[Array, "E K K"],
        posterior: Float[Array, "E K K"],
        evidence: Bool[Array, "E 1"],
    ) -> Self:
        """Bayes' rule: a type that has begun in the step has age 0, one that lasts has not."""
        before, after = _begins_or_lasts(joint), _begins_or_lasts(posterior)
        change = after / jnp.maximum(before, _MIN_PROBABILITY)
        change = jnp.repeat(change, np.array([1, self.age.shape[-1] - 1]), axis=-1)
        age = jnp.where(evidence[..., None], _normalised(self.age * change), self.age)
        return dataclasses.replace(self, age=age.astype(self.age.dtype))


def _begins_or_lasts(joint: Float[Array, "E K K"]) -> Float[Array, "E K 2"]:
    """Probability that an edge has a type after the step only, and after and before it."""
    lasts = jnp.einsum("ekk->ek", joint)
    return jnp.stack([jnp.sum(joint, axis=1) - lasts, lasts], axis=-1)


def _normalised(values: Float[Array, "*T A"]) -> Float[Array, "*T A"]:
    """Shares of the sum; 0 where all are."""
    total = jnp.sum(values, axis=-1, keepdims=True)
    return values / jnp.where(total > 0, total, 1.0)


def aged(flow: Float[Array, "E K A K"]) -> Float[Array, "E K A"]:
    """The probability of each type and age after a step, from that of each type and age before it
    and type after it."""
    lasting = jnp.einsum("ekak->eka", flow)
    begun = jnp.sum(flow, axis=(1, 2)) - jnp.sum(lasting, axis=-1)
    table = jnp.concatenate([begun[..., None], lasting], axis=-1)
    longest = jnp.sum(table[..., -2:], axis=-1, keepdims=True)
    return jnp.concatenate([table[..., :-2], longest], axis=-1)


class DurationEdges(EdgeInference):
    r"""An explicit-duration hidden Markov model (hidden semi-Markov model) for every edge.

    The belief is a table over types k and ages a, the steps for which an edge has had its type:

    $$ F_{ka \to j} = b_{ka} T_{kaj}, \quad
       b'_{j0} = \sum_{k \ne j, a} F_{ka \to j}, \quad b'_{j,a+1} = F_{ja \to j}, $$

    so that a contact may last for exactly known times (Yu 2010, Hidden semi-Markov models). With
    features f of the edge and the geometric prior q, whether the bodies meet in the step under the
    command that is given, the transition to a type h that holds is

    $$ T_{kah} = m_{kh}\, \mathrm{softmax}_h\big(\beta_{kah} + U_{kh} f\big)
       \big/ \big(1 + (g / \ell_{kh})^{s_{kh}}\big), \quad
       m_{kh} = 1 \text{ if } k = h, \text{ else } 1 - q_0, $$

    with 0 in the softmax for none that holds. What is left is shared by *free* and *touch*: by q,
    and what it was before. T is at least `min_transition`, to active types as far as the bodies
    meet. A touch is over where there is a gap before the step. The features are that gap, the types
    of the ends and the switches of actuated ends: no force, because what a planner intends is no
    evidence of contact. The pull g can only end a hold: by how many contact distances the control
    drives an actuated end away from the other one.
    """

    coefficients: Float[Array, "K H F"]
    """U, in units of `_PACE`."""
    odds: Float[Array, "K A H"]
    r"""$\beta$ of the types that hold, in units of `_PACE`."""
    strength: Float[Array, "2 K H"]
    r"""Logarithm of $\ell$, and of what s is above 2, in units of `_PACE`."""
    edge_types: tuple[EdgeType, ...] = eqx.field(static=True)
    servos: tuple[bool, ...] = eqx.field(static=True)
    """The node types that a servo drives: of these the control does not tell the pull."""
    min_transition: float = eqx.field(static=True)
    """Least probability of any transition in a step: no type is certain to last, or to change. That
    to active types has a share of it, the probability that the bodies meet."""

    def __init__(
        self,
        servos: tuple[bool, ...],
        edge_types: tuple[EdgeType, ...] = (HOLD,),
        commands: int = 0,
        min_transition: float = 2e-3,
        limit: float = 1.0,
    ):
        """``commands``: the switches; ``limit``: of pulls, before training."""
        count, inputs = 1 + len(edge_types), len(GAP_SCALES) + commands + len(servos)
        holds = np.flatnonzero([False, *(not each.unilateral for each in edge_types)])
        self.coefficients = jnp.zeros((count, len(holds), inputs))
        odds = np.full((count, _AGES, len(holds)), _BEGINS)
        odds[holds, :, np.arange(len(holds))] = _LASTS
        self.odds = jnp.asarray(odds / _PACE, float)
        self.strength = jnp.zeros((2, count, len(holds))).at[0].set(np.log(limit) / _PACE)
        self.edge_types = edge_types
        self.commands = commands
        self.servos = servos
        self.min_transition = min_transition

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
        **step: Any,
    ) -> Float[Array, "E M"]:
        """Features of every edge, its pull, approach and gap; the types come first in ``node``."""
        ends = jnp.sum(node[edge_index, : len(self.servos)], axis=0)
        known = pull_approach_gap_and_switches(switches=self.commands, **step).astype(node.dtype)
        pull = known[:, :1] * (ends @ np.array(self.servos) == 0.0)[:, None]
        own = jnp.concatenate([pull, known[:, np.array([1, 1 + len(GAP_SCALES)])]], axis=-1)
        return jnp.concatenate([known[:, 2:], ends, own], axis=-1)

    def init(self, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]) -> ContactBelief:
        """The geometric prior, of unknown ages."""
        age = jnp.zeros((*prior.shape, _AGES), prior.dtype)
        return ContactBelief(prior, memory=EdgeAges(age), edge_types=self.edge_types)

    def table(self, belief: ContactBelief) -> Float[Array, "E K A"]:
        """The probability of each type and age."""
        age = _normalised(cast(EdgeAges, belief.memory).age)
        unknown = np.zeros(age.shape[-2:])
        unknown[0, -1] = unknown[1:, 0] = 1.0
        known = jnp.any(age > 0, axis=-1, keepdims=True)
        return belief.type_probability[..., None] * jnp.where(known, age, unknown)

    def parted(
        self, table: Float[Array, "E K A"], embedding: Float[Array, "E M"]
    ) -> Float[Array, "E K A"]:
        """What touched is free where there is a gap before the step: its next touch is another."""
        unilateral = np.array([False, *(each.unilateral for each in self.edge_types)])
        ended = jnp.where(unilateral[:, None] & (embedding[:, -1:, None] > 0), table, 0.0)
        new = np.zeros(table.shape[1:])
        new[0, 0] = 1.0
        return table - ended + new * jnp.sum(ended, axis=(1, 2), keepdims=True)

    def transitions(
        self, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> Float[Array, "E K A K"]:
        """T: the probability of each type after the step, given type and age before it."""
        count, (limit, steeper) = prior.shape[1], _PACE * self.strength
        features, (pull, approaches, gap) = embedding[:, :-3], embedding[:, -3:].T
        meets = jnp.maximum(1.0 - prior[:, 0], _MIN_PROBABILITY)
        unilateral = np.array([False, *(each.unilateral for each in self.edge_types)])
        types, free = np.arange(count), np.arange(count) == 0
        holds = np.flatnonzero(~unilateral & ~free)
        # A hold lasts wherever its ends are driven, and begins where they meet.
        odds = _PACE * jnp.einsum("khf,ef->ekh", self.coefficients, features)
        odds -= _DISTANT * jnp.maximum(gap, 0.0)[:, None, None]
        # Exponentials of each summand alone: there are many ages, and few sums of features.
        odds, by_age = (jnp.exp(jnp.clip(x, -_SURE, _SURE)) for x in (odds, _PACE * self.odds))
        held = odds[:, :, None] * by_age
        held /= 1.0 + jnp.sum(held, axis=-1, keepdims=True)
        # A strong pull ends it, whatever the odds.
        excess = jnp.log(jnp.maximum(pull, _MIN_PROBABILITY))[:, None, None] - limit
        unbroken = jax.nn.sigmoid(-(2.0 + jnp.exp(steeper)) * excess)
        lasts = holds == types[:, None]
        held *= (unbroken * jnp.where(lasts, 1.0, meets[:, None, None]))[:, :, None]
        # Geometry says whether bodies that are not held touch.
        stays_free = jnp.where(approaches[:, None] > 0, 0.0, _STAYS_FREE)
        stays = jnp.where(free, stays_free, jnp.where(unilateral, _TOUCHES, 0.0))
        others = jnp.where(gap[:, None] > 0, 0.0, stays)[:, None] * np.eye(count)
        apart = jnp.log(jnp.maximum(prior[:, :1], _MIN_PROBABILITY))
        others += jnp.where(free, apart, unilateral * jnp.log(meets)[:, None])[:, None]
        others = jax.nn.softmax(others, where=free | unilateral)
        none_held = 1.0 - jnp.sum(held, axis=-1, keepdims=True)
        after = others[:, :, None] * none_held + held @ (holds[:, None] == types)
        least = self.min_transition * jnp.where(free, 1.0, 1.0 - prior[:, :1])
        least = least[:, None, None]
        return least + (1.0 - jnp.sum(least, axis=-1, keepdims=True)) * after

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The belief about the next step, and the probability of pairs of types."""
        table = self.parted(self.table(belief), embedding)
        flow = table[..., None] * self.transitions(embedding, prior)
        joint, table = jnp.sum(flow, axis=2), aged(flow)
        types = jnp.sum(joint, axis=1)
        memory = EdgeAges(_normalised(table))
        return ContactBelief(types, memory=memory, edge_types=self.edge_types), joint


def smoothed_flows(
    inference: EdgeInference,
    first: Float[Array, "E K A"],
    embedding: Float[Array, "L E M"],
    transitions: Float[Array, "L E K A K"],
    log_ratio: Float[Array, "L E K K"],
) -> Float[Array, "L E K A K"]:
    """Probability of each type and age before every step and type after it, given all steps.

    The forward and backward recursions (Rabiner 1989, section III) over the table of types and
    ages; ``first`` is that before the first step, ``log_ratio`` the log-likelihood of each step's
    observations given the types before and after it, up to a constant.
    """
    likelihood = jnp.exp(log_ratio - jnp.max(log_ratio, axis=(-2, -1), keepdims=True))
    moved = transitions * likelihood[:, :, :, None]
    same = np.eye(first.shape[1])[:, None]

    def forward(table: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        embedding, moved = step
        table = inference.parted(table, embedding)
        after = aged(table[..., None] * moved)
        return after / jnp.sum(after, axis=(-2, -1), keepdims=True), table

    def backward(after: Array, step: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        embedding, moved, table = step
        longer = jnp.concatenate([after[..., 1:], after[..., -1:]], axis=-1)
        begun = after[:, None, None, :, 0]
        future = moved * (begun + same * (longer[..., None] - begun))
        part = partial(inference.parted, embedding=embedding)
        (before,) = jax.linear_transpose(part, table)(jnp.sum(future, axis=-1))
        flow = table[..., None] * future
        flow = flow / jnp.maximum(jnp.sum(flow, axis=(1, 2, 3), keepdims=True), _SMALLEST)
        return before / jnp.max(before, axis=(-2, -1), keepdims=True), flow

    tables = jax.lax.scan(forward, first, (embedding, moved))[1]
    steps = embedding, moved, tables
    return jax.lax.scan(backward, jnp.ones_like(first), steps, reverse=True)[1]


class PriorEdges(EdgeInference):
    """The geometric prior alone, as an ablation of inference: no belief survives a step.

    The prior knows no types, so all of its active part is of one. Corrections still apply to the
    step just made. With ``least`` 1 every edge is active at every step (the paper's No-GIM).
    """

    edge_types: tuple[EdgeType, ...] = eqx.field(static=True, default=(HOLD,))
    active_type: int = eqx.field(static=True, default=1)
    """With 0, the free type, no edge is ever active."""
    least: float = eqx.field(static=True, default=0.0)
    """Probability that an edge is active whatever its prior."""

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E 0"], prior: Float[Array, "E K"]
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The prior; pairs of equal types, none of which motion makes possible if it is not."""
        active = self.least + (1.0 - self.least) * jnp.sum(prior[:, 1:], axis=-1)
        types = jnp.zeros_like(prior).at[:, 0].set((1.0 - self.least) * prior[:, 0])
        types = types.at[:, self.active_type].add(active)
        joint = types[:, :, None] * jnp.eye(types.shape[-1], dtype=types.dtype)
        return ContactBelief(types, edge_types=self.edge_types), joint
