"""How far seen motion may be off a prediction, and what that says for one prediction or another."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.data.errors import InvalidInputError
from contactgraph.model.contact_belief import ContactBelief
from contactgraph.model.contact_dynamics import (
    ContactDynamics,
    EncodedGraph,
    cast_like,
    control_sensitivity,
    with_control_displacement,
)
from contactgraph.model.types import ModelState, Nodes

Motion = tuple[Float[Array, "N D"], Float[Array, "N D"]]
"""Position [m] and velocity [m/s] of every node."""


class MotionNoise(eqx.Module):
    r"""Standard deviations of what is observed and of what is predicted.

    Of two predictions of one node, which differ by :math:`\delta_x` in position and
    :math:`\delta_v` in velocity, the errors :math:`e_x, e_v` are taken to have the variances

    .. math::
        s_v^2 = 2 \sigma_v^2 + m_v^2 + r^2 \|\delta_v\|^2, \qquad
        s_x^2 = 2 \sigma_x^2 + dt^2 \sigma_v^2 + m_x^2
            + r^2 (\|\delta_x\|^2 + dt^2 \|\delta_v\|^2).

    Both observations of a step are noisy, hence the 2. What a contact changes is predicted to a
    share only: when in the step an impact comes, and how much of it there is, depends on
    distances that are known to a few per cent.

    Of a node whose two predictions differ by no more than the noise, :math:`\|\delta\|^2 / s^2`
    without r at most D, nothing is said: the state from which is predicted is noisy itself, and a
    contact, which averages over two bodies, would always fit noise a little better.

    Raises `InvalidInputError` where a number is negative, or where neither observation nor model
    is ever wrong.
    """

    position: float = 0.0
    """Of one observed position, on each axis, m."""
    velocity: float = 0.0
    """Of one observed velocity, on each axis, m/s."""
    model_position: float = 5e-4
    """Of a predicted position after one step, m."""
    model_velocity: float = 1e-2
    """Of a predicted velocity after one step, m/s."""
    model_share: float = 0.4
    """r; of what a contact changes, the share that a prediction of it is off by."""
    tail: float = eqx.field(static=True, default=4.0)
    """Degrees of freedom of Student's t: the fewer, the less one frame that fits nothing says."""
    max_log_ratio: float = eqx.field(static=True, default=6.0)
    """Bound on the log-likelihood ratio of one step: odds of 400."""
    error_floor: float = eqx.field(static=True, default=0.01)
    """How probable a mistake of the model is taken to be where motion contradicts its belief."""
    time_constant: float = eqx.field(static=True, default=5.0)
    """s; how long a contact is taken to last that nothing more is seen of."""

    def __check_init__(self) -> None:
        numbers = {
            name: getattr(self, name)
            for name in ("position", "velocity", "model_position", "model_velocity", "model_share")
        }
        for name, value in numbers.items():
            if not isinstance(value, Array) and not 0.0 <= value < float("inf"):
                raise InvalidInputError(f"{name} must be at least 0 and finite, found {value}")
        for name, both in (
            ("position", (self.position, self.model_position)),
            ("velocity", (self.velocity, self.model_velocity)),
        ):
            if not any(isinstance(one, Array) for one in both) and not any(both):
                raise InvalidInputError(
                    f"{name} and model_{name} must not both be 0: nothing would ever fit"
                )

    def log_ratio(
        self, one: Motion, other: Motion, seen: Motion, exists: Bool[Array, " N"], dt: float
    ) -> Float[Array, ""]:
        """Log-likelihood of ``seen`` under the prediction ``one`` less that under ``other``.

        Exactly 0 where the two agree; heavy tails, so that what fits neither says little.
        """
        difference_x, difference_v = _square(one[0], other[0]), _square(one[1], other[1])
        base_v = 2.0 * self.velocity**2 + self.model_velocity**2
        base_x = 2.0 * self.position**2 + (dt * self.velocity) ** 2 + self.model_position**2
        share = self.model_share**2
        varies_v = base_v + share * difference_v
        varies_x = base_x + share * (difference_x + dt**2 * difference_v)

        def log_likelihood(predicted: Motion) -> Float[Array, " N"]:
            off = _square(seen[0], predicted[0]) / varies_x
            off = off + _square(seen[1], predicted[1]) / varies_v
            power = 0.5 * (self.tail + 2 * seen[0].shape[-1])
            return -power * jnp.log1p(off / self.tail)

        contrast = difference_x / base_x + difference_v / base_v
        counts = 1.0 - seen[0].shape[-1] / jnp.maximum(contrast, seen[0].shape[-1])
        said = counts * (log_likelihood(one) - log_likelihood(other))
        said = jnp.where(exists, said, 0.0)
        ratio = jnp.sum(said)
        return jnp.clip(
            jnp.where(jnp.isfinite(ratio), ratio, 0.0), -self.max_log_ratio, self.max_log_ratio
        )


def _square(one: Float[Array, "N D"], other: Float[Array, "N D"]) -> Float[Array, " N"]:
    return jnp.sum((one - other) ** 2, axis=-1)


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
    motion_log_odds: Float[Array, " E"]
    """Log-odds, at least 0, by which motion has spoken for contact lately: what is remembered."""
    corrected: ContactBelief
    """[E, K] by `log_ratio`; to the bit as predicted where that is 0."""


def check_motion_model(model: object) -> ContactDynamics:
    """The model, if it is one that can judge motion; else raises `InvalidInputError`."""
    if not isinstance(model, ContactDynamics):
        raise InvalidInputError(
            "motion_noise: only a ContactDynamics says how things would move with an edge active "
            f"and without; found {type(model).__name__}"
        )
    if model.neighbor_list is not None:
        raise InvalidInputError(
            "motion_noise: what motion has told of each pair is kept for all of them, so the model "
            "must have no neighbour lists (neighbor_list=None)"
        )
    return model


def correct_by_motion(
    model: ContactDynamics,
    carried: ContactBelief,
    before: ModelState,
    motion_log_odds: Float[Array, " E"],
    control: Float[Array, " U"],
    seen: Motion,
    nodes: Nodes,
    noise: MotionNoise,
) -> tuple[ContactBelief, Float[Array, " E"]]:
    """The belief about the step just made, and `MotionEvidence.motion_log_odds`.

    As ``carried`` and ``told`` where one of the step's two observations is not finite: the first
    one of a run has none before it, and a bad one judges neither of its steps.
    """
    evidence = contact_log_likelihood_ratio(
        model, before, motion_log_odds, control, seen, nodes, noise
    )
    observed = (before.position, before.velocity, *seen)
    whole = jnp.all(jnp.stack([jnp.all(jnp.isfinite(one)) for one in observed]))
    found = cast_like(evidence.corrected, carried), evidence.motion_log_odds
    return jax.tree.map(
        lambda new, old: jnp.where(whole, new, old), found, (carried, motion_log_odds)
    )


def contact_log_likelihood_ratio(
    model: ContactDynamics,
    before: ModelState,
    motion_log_odds: Float[Array, " E"],
    control: Float[Array, " U"],
    seen: Motion,
    nodes: Nodes,
    noise: MotionNoise,
) -> MotionEvidence:
    """Judges the step from ``before`` under ``control`` [N], as applied, to what was ``seen``.

    ``before.belief`` is about the step that led to ``before``, corrected by all that was known
    then, and ``told`` is of that step, too (zeros: motion has told nothing yet).
    """
    state = with_control_displacement(before, control_sensitivity(model, before, nodes), control)
    percept = model.encode(state.position, state.velocity, nodes, state.control_displacement)
    stay = jnp.exp(-model.dt / noise.time_constant)
    remembered = jnp.minimum(1.0 - jnp.exp(-motion_log_odds), before.belief.probability)
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
        after = _after(predicted.type_probability[edge], ratio, noise.error_floor)[0] < 0.5
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
    ratio = (
        jnp.zeros(motion_log_odds.shape, motion_log_odds.dtype)
        .at[edges]
        .set(said.astype(motion_log_odds.dtype))
    )
    types = predicted.type_probability
    after = jax.vmap(_after, in_axes=(0, 0, None))(types, ratio, noise.error_floor)
    return MotionEvidence(
        predicted=predicted,
        log_ratio=ratio,
        motion_log_odds=jnp.clip(stay * motion_log_odds + ratio, 0.0, noise.max_log_ratio),
        corrected=ContactBelief(jnp.where(ratio[:, None] != 0, after, types)),
    )


def _after(
    types: Float[Array, " K"], log_ratio: Float[Array, ""], error_floor: float
) -> Float[Array, " K"]:
    """Bayes' rule on an edge. A belief that motion contradicts is taken as no surer than
    ``error_floor`` allows: a network is sure of what it has not seen the like of."""
    active = jnp.maximum(types[1:], _SMALLEST)
    odds = jnp.log(jnp.sum(active)) - jnp.log(jnp.maximum(types[0], _SMALLEST))
    surest = jnp.log((1.0 - error_floor) / error_floor)
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
    model: ContactDynamics, state: ModelState, percept: EncodedGraph, nodes: Nodes
) -> EncodedGraph:
    """The same step, if bodies touch wherever they come nearest in it.

    A network that knows the distance of touch does not let an active edge hold beyond it, however
    sure it is told to be: then active and inactive would be the same motion. What is asked is what
    follows if this edge does hold; how probable that is at its distance is the belief's affair.
    """
    touch = jnp.maximum(
        model.features.contact_distance, _TOUCHING * percept.geometry.closest_approach
    )
    return model.encode(state.position, state.velocity, nodes, state.control_displacement, touch)


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


def _nearest(percept: EncodedGraph) -> Int[Array, " considered"]:
    """Of the edges in reach, those whose ends come nearest within the step."""
    near = jnp.where(percept.weight > 0, -percept.geometry.closest_approach, -jnp.inf)
    return jax.lax.top_k(near, min(_CONSIDERED, near.shape[0]))[1]
