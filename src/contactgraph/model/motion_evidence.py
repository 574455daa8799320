r"""Contact without a sensor: what the motion just seen says about every edge.

For an edge e, the model predicts the step just made twice, with the edge active and without, all
others as they are most probably; how well each fits what was then observed is the evidence,

.. math:: \ell_e = \log p(x_{t+1} | x_t, u_t, e\ \text{active})
    - \log p(x_{t+1} | x_t, u_t, e\ \text{inactive}),

and the belief's log-odds become those predicted plus :math:`\ell_e`. Where both predictions are
the same motion, nothing can be seen, :math:`\ell_e = 0`, and the belief stays as predicted.

Predicted it is by the model, from the belief before, but with a memory: what motion has spoken for
stays in contact, as in a hidden Markov model, with the probability :math:`e^{-dt/\tau}` a step,
however improbable its distance makes that. A model whose idea of where bodies touch is a few
millimetres off would else forget as soon as nothing accelerates. What motion has not spoken for,
the model alone remembers.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.data.errors import InvalidInputError
from contactgraph.model.belief import ContactBelief
from contactgraph.model.contact_dynamics import ContactDynamics, Percept
from contactgraph.model.motion_noise import Motion, MotionNoise
from contactgraph.model.push import held_response, in_type_of, pushed
from contactgraph.model.state import ModelState, Nodes

_CONSIDERED = 8
"""Edges that are judged in a step, nearest first: more bodies than these do not touch at once
anew, and the cost of a tick must not grow with the square of the number of bodies."""
_TOUCHING = 1.02
"""Of their distance, what bodies that touch are taken to touch at: clearly, not to the micron."""
_SMALLEST = 1e-6


class MotionEvidence(eqx.Module):
    """What one observed step says, on top of what those before it have said."""

    predicted: ContactBelief
    """[E, K] about the step, from what was believed before it and the control applied in it."""
    log_ratio: Float[Array, " E"]
    """Log-likelihood of the motion with the edge active less that without; 0: says nothing."""
    told: Float[Array, " E"]
    """Log-odds, at least 0, by which motion has spoken for contact lately: what is remembered."""
    corrected: ContactBelief
    """[E, K] by `log_ratio`; to the bit as predicted where that is 0."""


def judging_motion(model: object) -> ContactDynamics:
    """The model, if it is one that can judge motion; else raises `InvalidInputError`."""
    if not isinstance(model, ContactDynamics):
        raise InvalidInputError(
            "motion_noise: only a ContactDynamics says how things would move with an edge active "
            f"and without; found {type(model).__name__}"
        )
    if model.neighbours is not None:
        raise InvalidInputError(
            "motion_noise: what motion has told of each pair is kept for all of them, so the model "
            "must have no neighbour lists (neighbours=None)"
        )
    return model


def correct_by_motion(
    model: ContactDynamics,
    carried: ContactBelief,
    before: ModelState,
    told: Float[Array, " E"],
    control: Float[Array, " U"],
    seen: Motion,
    nodes: Nodes,
    noise: MotionNoise,
) -> tuple[ContactBelief, Float[Array, " E"]]:
    """The belief about the step just made, and `MotionEvidence.told`, of `judge_motion`.

    As ``carried`` and ``told`` where one of the step's two observations is not finite: the first
    one of a run has none before it, and a bad one judges neither of its steps.
    """
    evidence = judge_motion(model, before, told, control, seen, nodes, noise)
    observed = (before.position, before.velocity, *seen)
    whole = jnp.all(jnp.stack([jnp.all(jnp.isfinite(one)) for one in observed]))
    found = in_type_of(evidence.corrected, carried), evidence.told
    return jax.tree.map(lambda new, old: jnp.where(whole, new, old), found, (carried, told))


def judge_motion(
    model: ContactDynamics,
    before: ModelState,
    told: Float[Array, " E"],
    control: Float[Array, " U"],
    seen: Motion,
    nodes: Nodes,
    noise: MotionNoise,
) -> MotionEvidence:
    """Judges the step from ``before`` under ``control`` [N], as applied, to what was ``seen``.

    ``before.belief`` is about the step that led to ``before``, corrected by all that was known
    then, and ``told`` is of that step, too (zeros: motion has told nothing yet).
    """
    state = pushed(before, held_response(model, before, nodes), control)
    percept = model.perceive(state.position, state.velocity, nodes, state.push)
    stay = jnp.exp(-model.dt / noise.lasting)
    remembered = jnp.minimum(1.0 - jnp.exp(-told), before.belief.probability)
    predicted = model.predict_belief(state.belief, percept)
    predicted = _at_least(predicted, before.belief, stay * percept.weight * remembered)
    holding = _as_if_touching(model, state, percept, nodes)

    def moved(types: Float[Array, "E K"]) -> Motion:
        local = model.local_input(
            holding, ContactBelief(types), state.position, state.velocity, nodes
        )
        linear = model.local_dynamics(local, model.dt, model.control_size)
        return linear(state.position, state.velocity, control)

    Carry = tuple[Float[Array, "E K"], Motion]

    def judge(carry: Carry, edge: Int[Array, ""]) -> tuple[Carry, Float[Array, ""]]:
        types, motion = carry
        is_active = types[edge, 0] == 0
        otherwise = types.at[edge].set(_other(predicted, is_active, edge))
        other_motion = moved(otherwise)
        ratio = noise.log_ratio(motion, other_motion, seen, nodes.mask, model.dt)
        # An edge out of reach is inactive, surely, whatever moves.
        ratio = jnp.where(percept.weight[edge] > 0, jnp.where(is_active, ratio, -ratio), 0.0)
        after = _after(predicted.type_probability[edge], ratio, noise.doubt)[0] < 0.5
        turned = after != is_active
        chosen = jax.tree.map(
            lambda new, old: jnp.where(turned, new, old), (otherwise, other_motion), carry
        )
        return chosen, ratio

    # The nearest first, each given what was found of those before it: what one contact explains
    # is no evidence for another.
    edges = _nearest(percept)
    probable = _most_probable(predicted)
    said = jax.lax.scan(judge, (probable, moved(probable)), edges)[1]
    ratio = jnp.zeros(told.shape, told.dtype).at[edges].set(said.astype(told.dtype))
    types = predicted.type_probability
    after = jax.vmap(_after, in_axes=(0, 0, None))(types, ratio, noise.doubt)
    return MotionEvidence(
        predicted=predicted,
        log_ratio=ratio,
        told=jnp.clip(stay * told + ratio, 0.0, noise.most),
        corrected=ContactBelief(jnp.where(ratio[:, None] != 0, after, types)),
    )


def _after(
    types: Float[Array, " K"], log_ratio: Float[Array, ""], doubt: float
) -> Float[Array, " K"]:
    """Bayes' rule on an edge. A belief that motion contradicts is taken as no surer than ``doubt``
    allows: a network is sure of what it has not seen the like of."""
    active = jnp.maximum(types[1:], _SMALLEST)
    odds = jnp.log(jnp.sum(active)) - jnp.log(jnp.maximum(types[0], _SMALLEST))
    surest = jnp.log((1.0 - doubt) / doubt)
    contradicted = log_ratio * odds < 0
    odds = jnp.where(contradicted, jnp.clip(odds, -surest, surest), odds)
    # Motion tells active from inactive, not the active types from each other.
    share = active / jnp.sum(active)
    found = jax.nn.sigmoid(odds + log_ratio)
    return jnp.concatenate([1.0 - found[None], found * share])


def _at_least(
    predicted: ContactBelief, before: ContactBelief, least: Float[Array, " E"]
) -> ContactBelief:
    """As predicted, but every edge with the probability ``least`` active, of the types it was."""
    was = jnp.maximum(before.type_probability[:, 1:], _SMALLEST)
    kept = least[:, None] * was / jnp.sum(was, axis=-1, keepdims=True)
    active = predicted.type_probability[:, 1:]
    active = jnp.where(jnp.sum(active, axis=-1, keepdims=True) < least[:, None], kept, active)
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
    belief: ContactBelief, is_active: Bool[Array, ""], edge: Int[Array, ""]
) -> Float[Array, " K"]:
    """The type against which an edge's most probable one is held: inactive, or the likeliest
    active one."""
    types = belief.type_probability[edge]
    active = 1 + jnp.argmax(types[1:])
    return jax.nn.one_hot(jnp.where(is_active, 0, active), len(types), dtype=types.dtype)


def _nearest(percept: Percept) -> Int[Array, " considered"]:
    """Of the edges in reach, those whose ends come nearest within the step."""
    near = jnp.where(percept.weight > 0, -percept.geometry.nearest, -jnp.inf)
    return jax.lax.top_k(near, min(_CONSIDERED, near.shape[0]))[1]
