r"""Contact without a sensor: what the motion just seen says about every edge.

For an edge e, the model predicts the step just made twice, with the edge active and without, all
others as they are most probably; how well each fits what was then observed is the evidence,

.. math:: \ell_e = \log p(x_{t+1} | x_t, u_t, e\ \text{active})
    - \log p(x_{t+1} | x_t, u_t, e\ \text{inactive}),

and the belief's log-odds become those predicted plus :math:`\ell_e`. Where both predictions are
the same motion, nothing can be seen, :math:`\ell_e = 0`, and the belief stays as predicted.

Predicted it is by the model, from the belief before, but with a memory: what was in contact stays
so, as in a hidden Markov model, with the probability :math:`e^{-dt/\tau}` a step, however
improbable its distance makes that. A model whose idea of where bodies touch is a few millimetres
off would else forget, as soon as nothing accelerates, what motion has told.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.model.belief import ContactBelief
from contactgraph.model.contact_dynamics import ContactDynamics, Percept
from contactgraph.model.motion_noise import Motion, MotionNoise
from contactgraph.model.push import held_response, pushed
from contactgraph.model.state import ModelState, Nodes

_CONSIDERED = 8
"""Edges that are judged in a step, nearest first: more bodies than these do not touch at once
anew, and the cost of a tick must not grow with the square of the number of bodies."""
_TOUCHING = 1.02
"""Of their distance, what bodies that touch are taken to touch at: clearly, not to the micron."""
_SMALLEST = 1e-6


class MotionEvidence(eqx.Module):
    """What one observed step says."""

    predicted: ContactBelief
    """[E, K] about the step, from what was believed before it and the control applied in it."""
    log_ratio: Float[Array, " E"]
    """Log-likelihood of the motion with the edge active less that without; 0: says nothing."""

    def corrected(self, noise: MotionNoise) -> ContactBelief:
        """Bayes' rule. A belief that motion contradicts is taken as no surer than the model's
        ``noise.doubt`` allows; one without evidence stays what it is, to the bit."""
        types = self.predicted.type_probability
        active = jnp.sum(types[..., 1:], axis=-1)
        odds = jnp.log(jnp.maximum(active, _SMALLEST))
        odds = odds - jnp.log(jnp.maximum(types[..., 0], _SMALLEST))
        surest = jnp.log((1.0 - noise.doubt) / noise.doubt)
        contradicted = self.log_ratio * odds < 0
        odds = jnp.where(contradicted, jnp.clip(odds, -surest, surest), odds)
        after = jax.nn.sigmoid(odds + self.log_ratio)
        # Motion tells active from inactive, not the active types from each other.
        share = (types[..., 1:] + _SMALLEST) / jnp.sum(types[..., 1:] + _SMALLEST, -1)[..., None]
        posterior = jnp.concatenate([1.0 - after[..., None], after[..., None] * share], axis=-1)
        seen = self.log_ratio[..., None] != 0
        return ContactBelief(jnp.where(seen, posterior, types))


def judge_motion(
    model: ContactDynamics,
    before: ModelState,
    control: Float[Array, " U"],
    seen: Motion,
    nodes: Nodes,
    noise: MotionNoise,
) -> MotionEvidence:
    """Judges the step from ``before`` under ``control`` [N], as applied, to what was ``seen``.

    ``before.belief`` is about the step that led to ``before``, corrected by all that was known
    then. Numbers that are not finite are no evidence.
    """
    state = pushed(before, held_response(model, before, nodes), control)
    percept = model.perceive(state.position, state.velocity, nodes, state.push)
    predicted = model.predict_belief(state.belief, percept)
    predicted = _remembered(predicted, before.belief, percept, jnp.exp(-model.dt / noise.lasting))
    probable = _most_probable(predicted)
    holding = _as_if_touching(model, state, percept, nodes)

    def moved(edges: Float[Array, "E K"]) -> Motion:
        local = model.local_input(
            holding, ContactBelief(edges), state.position, state.velocity, nodes
        )
        linear = model.local_dynamics(local, model.dt, model.control_size)
        return linear(state.position, state.velocity, control)

    as_believed = moved(probable)
    is_active = probable[:, 0] == 0

    def said_of(edge: Int[Array, ""]) -> Float[Array, ""]:
        otherwise = moved(probable.at[edge].set(_other(predicted, is_active, edge)))
        ratio = noise.log_ratio(as_believed, otherwise, seen, nodes.mask, model.dt)
        return jnp.where(is_active[edge], ratio, -ratio)

    edges = _nearest(percept)
    ratio = jnp.zeros(is_active.shape, state.velocity.dtype)
    said = jax.vmap(said_of)(edges).astype(ratio.dtype)
    # An edge out of reach is inactive, surely, whatever moves.
    ratio = ratio.at[edges].set(jnp.where(percept.weight[edges] > 0, said, 0.0))
    return MotionEvidence(predicted, ratio)


def _remembered(
    predicted: ContactBelief, before: ContactBelief, percept: Percept, stay: Float[Array, ""]
) -> ContactBelief:
    """As predicted, but no edge in reach forgets more than memory allows, of no active type."""
    kept = stay * percept.weight[:, None] * before.type_probability[:, 1:]
    active = predicted.type_probability[:, 1:]
    forgets = jnp.sum(active, -1, keepdims=True) < jnp.sum(kept, -1, keepdims=True)
    active = jnp.where(forgets, kept, active)
    inactive = 1.0 - jnp.sum(active, axis=-1, keepdims=True)
    return ContactBelief(jnp.concatenate([inactive, active], axis=-1))


def _as_if_touching(
    model: ContactDynamics, state: ModelState, percept: Percept, nodes: Nodes
) -> Percept:
    """The same step, if bodies touch wherever they come nearest in it.

    A network that knows the distance of touch does not let an active edge hold beyond it, however
    sure it is told to be: then active and inactive would be the same motion. What is asked is what
    follows if this edge does hold; how probable that is at its distance is the belief's affair.
    """
    touch = jnp.maximum(model.features.touch_distance, _TOUCHING * percept.geometry.nearest)
    return model.perceive(state.position, state.velocity, nodes, state.push, touch)


def _most_probable(belief: ContactBelief) -> Float[Array, "E K"]:
    types = belief.type_probability
    return jax.nn.one_hot(jnp.argmax(types, axis=-1), types.shape[-1], dtype=types.dtype)


def _other(
    belief: ContactBelief, is_active: Float[Array, " E"], edge: Int[Array, ""]
) -> Float[Array, " K"]:
    """The type against which an edge's most probable one is held: inactive, or the likeliest
    active one."""
    types = belief.type_probability[edge]
    active = 1 + jnp.argmax(types[1:])
    return jax.nn.one_hot(jnp.where(is_active[edge], 0, active), len(types), dtype=types.dtype)


def _nearest(percept: Percept) -> Int[Array, " considered"]:
    """Of the edges in reach, those whose ends come nearest within the step."""
    near = jnp.where(percept.weight > 0, -percept.geometry.nearest, -jnp.inf)
    return jax.lax.top_k(near, min(_CONSIDERED, near.shape[0]))[1]
