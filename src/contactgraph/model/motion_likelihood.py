r"""Contact without a sensor: likelihood of the observed motion with and without each edge.

For an edge e, the model predicts the last step twice, with the edge active and without it, all
others as is most probable; the evidence is how much better one fits the observation,

.. math:: \ell_e = \log p(x_{t+1} | x_t, u_t, e\ \text{active})
    - \log p(x_{t+1} | x_t, u_t, e\ \text{inactive}),

and the belief's log-odds become the predicted ones plus :math:`\ell_e`. Where both predictions are
the same motion, :math:`\ell_e = 0`, and the belief stays as predicted.

The prediction is the model's, from the belief before, with a memory: a contact that motion has
supported persists, as in a hidden Markov model, with the probability :math:`e^{-dt/\tau}` a step,
however improbable its distance makes it. Otherwise a model whose contact distance is a few
millimetres off would forget a contact as soon as nothing accelerates. Contacts without support by
motion are remembered by the model alone.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.data.errors import InvalidInputError
from contactgraph.model.contact_belief import ContactBelief, cast_like
from contactgraph.model.contact_dynamics import ContactDynamics, EncodedGraph
from contactgraph.model.rollout import control_sensitivity, with_control_displacement
from contactgraph.model.types import ModelState, Nodes

Motion = tuple[Float[Array, "N D"], Float[Array, "N D"]]
"""Position [m] and velocity [m/s] of every node."""

_CONSIDERED = 8
"""Edges considered in a step, nearest first: rarely do more bodies make contact at once, and the
cost of a control step must not grow with the square of the number of bodies."""
_TOUCHING = 1.02
"""Contact distance of an edge assumed active, in units of its distance: clearly touching."""
_MIN_PROBABILITY = 1e-6


class MotionNoise(eqx.Module):
    r"""Standard deviations of observations and of predictions.

    For two predictions of one node, which differ by :math:`\delta_x` in position and
    :math:`\delta_v` in velocity, the errors :math:`e_x, e_v` have the variances

    .. math::
        s_v^2 = 2 \sigma_v^2 + m_v^2 + r^2 \|\delta_v\|^2, \qquad
        s_x^2 = 2 \sigma_x^2 + dt^2 \sigma_v^2 + m_x^2
            + r^2 (\|\delta_x\|^2 + dt^2 \|\delta_v\|^2).

    Both observations of a step are noisy, hence the 2. The effect of a contact is predicted up to a
    factor only: the time and size of an impact depend on distances known to a few per cent.

    A node whose two predictions differ by no more than the noise, :math:`\|\delta\|^2 / s^2`
    without r at most D, contributes nothing: the state from which the step is predicted is noisy
    itself, and a contact, which averages over two bodies, would always fit noise a little better.

    Raises `InvalidInputError` where a number is negative, or where both observation and model are
    exact.
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
    """r; relative error of the predicted effect of a contact."""
    tail: float = eqx.field(static=True, default=4.0)
    """Degrees of freedom of Student's t: the fewer, the less weight has one outlier."""
    max_log_ratio: float = eqx.field(static=True, default=6.0)
    """Bound on the log-likelihood ratio of one step: odds of 400."""
    error_floor: float = eqx.field(static=True, default=0.01)
    """Least probability of a wrong belief of the model where motion contradicts it."""
    time_constant: float = eqx.field(static=True, default=5.0)
    """s; time for which a contact persists without further evidence."""

    def __check_init__(self) -> None:
        for name in ("position", "velocity", "model_position", "model_velocity", "model_share"):
            value = getattr(self, name)
            if not isinstance(value, Array) and not 0.0 <= value < float("inf"):
                raise InvalidInputError(f"{name} must be at least 0 and finite, found {value}")
        for name in ("position", "velocity"):
            both = getattr(self, name), getattr(self, f"model_{name}")
            if not any(isinstance(one, Array) for one in both) and not any(both):
                raise InvalidInputError(
                    f"{name} and model_{name} must not both be 0, since no motion would fit"
                )

    def log_ratio(
        self, one: Motion, other: Motion, observed: Motion, exists: Bool[Array, " N"], dt: float
    ) -> Float[Array, ""]:
        """Log-likelihood of ``observed`` under the prediction ``one`` less that under ``other``.

        Exactly 0 where the two agree; heavy tails bound the effect of an outlier.
        """
        difference_x, difference_v = _square(one[0], other[0]), _square(one[1], other[1])
        base_v = 2.0 * self.velocity**2 + self.model_velocity**2
        base_x = 2.0 * self.position**2 + (dt * self.velocity) ** 2 + self.model_position**2
        share = self.model_share**2
        variance_v = base_v + share * difference_v
        variance_x = base_x + share * (difference_x + dt**2 * difference_v)
        dimension = observed[0].shape[-1]

        def log_likelihood(predicted: Motion) -> Float[Array, " N"]:
            error = _square(observed[0], predicted[0]) / variance_x
            error = error + _square(observed[1], predicted[1]) / variance_v
            return -0.5 * (self.tail + 2 * dimension) * jnp.log1p(error / self.tail)

        contrast = difference_x / base_x + difference_v / base_v
        relevance = 1.0 - dimension / jnp.maximum(contrast, dimension)
        ratio = relevance * (log_likelihood(one) - log_likelihood(other))
        ratio = jnp.sum(jnp.where(exists, ratio, 0.0))
        ratio = jnp.where(jnp.isfinite(ratio), ratio, 0.0)
        return jnp.clip(ratio, -self.max_log_ratio, self.max_log_ratio)


def _square(one: Float[Array, "N D"], other: Float[Array, "N D"]) -> Float[Array, " N"]:
    return jnp.sum((one - other) ** 2, axis=-1)


class MotionEvidence(eqx.Module):
    """Evidence of one observed step about every edge."""

    predicted: ContactBelief
    """[E, K] about the step, from the belief before it and the control applied in it."""
    log_ratio: Float[Array, " E"]
    """Log-likelihood of the motion with the edge active less that without; 0: no evidence."""
    motion_log_odds: Float[Array, " E"]
    """Log-odds, at least 0, of contact by the motion of recent steps: the filter's memory."""
    corrected: ContactBelief
    """[E, K] by `log_ratio`; bit for bit as predicted where that is 0."""


def check_motion_model(model: object) -> ContactDynamics:
    """The model, if motion can be judged by it; else raises `InvalidInputError`."""
    if not isinstance(model, ContactDynamics):
        raise InvalidInputError(
            "motion_noise: the model must be a ContactDynamics, which predicts the motion with and "
            f"without each contact, found {type(model).__name__}"
        )
    if model.neighbor_list is not None:
        raise InvalidInputError(
            "motion_noise: the log-odds by motion are kept for all pairs, so the model must have "
            "no neighbor list (neighbor_list=None)"
        )
    return model


def correct_by_motion(
    model: ContactDynamics,
    carried: ContactBelief,
    before: ModelState,
    motion_log_odds: Float[Array, " E"],
    control: Float[Array, " U"],
    observed: Motion,
    nodes: Nodes,
    noise: MotionNoise,
) -> tuple[ContactBelief, Float[Array, " E"]]:
    """The corrected belief about the last step, and `MotionEvidence.motion_log_odds`.

    Both stay as ``carried`` and ``motion_log_odds`` where one of the step's two observations is not
    finite: the first of a trajectory has none before it, and a bad one is no evidence for either of
    its steps.
    """
    evidence = contact_log_likelihood_ratio(
        model, before, motion_log_odds, control, observed, nodes, noise
    )
    arrays = (before.position, before.velocity, *observed)
    usable = jnp.all(jnp.stack([jnp.all(jnp.isfinite(one)) for one in arrays]))
    after = cast_like(evidence.corrected, carried), evidence.motion_log_odds
    unchanged = carried, motion_log_odds
    return jax.tree.map(lambda new, old: jnp.where(usable, new, old), after, unchanged)


def contact_log_likelihood_ratio(
    model: ContactDynamics,
    before: ModelState,
    motion_log_odds: Float[Array, " E"],
    control: Float[Array, " U"],
    observed: Motion,
    nodes: Nodes,
    noise: MotionNoise,
) -> MotionEvidence:
    """Evidence of the step from ``before`` under the applied ``control`` [N] to ``observed``.

    ``before.belief`` is about the step that led to ``before``, corrected by all that was known
    then; ``motion_log_odds`` are of that step, too (zeros: no evidence by motion yet).
    """
    sensitivity = control_sensitivity(model, before, nodes)
    state = with_control_displacement(before, sensitivity, control)
    graph = model.encode(state.position, state.velocity, nodes, state.control_displacement)
    stay = jnp.exp(-model.dt / noise.time_constant)
    remembered = jnp.minimum(1.0 - jnp.exp(-motion_log_odds), before.belief.probability)
    predicted = model.predict_belief(state.belief, graph)
    predicted = _at_least(predicted, before.belief, stay * graph.weight * remembered)
    touching = _as_if_touching(model, state, graph)

    def moved(types: Float[Array, "E K"]) -> Motion:
        linear = model.linearize(model.cut_edges(touching, ContactBelief(types)))
        return linear(state.position, state.velocity, control)

    Carry = tuple[Float[Array, "E K"], Motion]

    def judge(carry: Carry, edge: Int[Array, ""]) -> tuple[Carry, Float[Array, ""]]:
        types, motion = carry
        is_active = types[edge, 0] == 0
        other_types = types.at[edge].set(_alternative(predicted, is_active, edge))
        other_motion = moved(other_types)
        ratio = noise.log_ratio(motion, other_motion, observed, nodes.mask, model.dt)
        # An edge beyond the cutoff is inactive with certainty, whatever moves.
        ratio = jnp.where(graph.weight[edge] > 0, jnp.where(is_active, ratio, -ratio), 0.0)
        after = _posterior(predicted.type_probability[edge], ratio, noise.error_floor)[0] < 0.5
        changes = after != is_active
        chosen = jax.tree.map(
            lambda new, old: jnp.where(changes, new, old), (other_types, other_motion), carry
        )
        return chosen, ratio

    # The nearest first, each given the result for those before it: a motion that one contact
    # explains is no evidence for another.
    edges = _nearest(graph)
    probable = _most_probable(predicted)
    ratios = jax.lax.scan(judge, (probable, moved(probable)), edges)[1]
    ratio = jnp.zeros_like(motion_log_odds).at[edges].set(ratios.astype(motion_log_odds.dtype))
    types = predicted.type_probability
    after = jax.vmap(_posterior, in_axes=(0, 0, None))(types, ratio, noise.error_floor)
    return MotionEvidence(
        predicted=predicted,
        log_ratio=ratio,
        motion_log_odds=jnp.clip(stay * motion_log_odds + ratio, 0.0, noise.max_log_ratio),
        corrected=ContactBelief(jnp.where(ratio[:, None] != 0, after, types)),
    )


def _posterior(
    types: Float[Array, " K"], log_ratio: Float[Array, ""], error_floor: float
) -> Float[Array, " K"]:
    """Bayes' rule on an edge. A belief that motion contradicts counts as no more certain than
    ``error_floor`` allows, because networks are overconfident outside of their training data."""
    active = jnp.maximum(types[1:], _MIN_PROBABILITY)
    log_odds = jnp.log(jnp.sum(active)) - jnp.log(jnp.maximum(types[0], _MIN_PROBABILITY))
    bound = jnp.log((1.0 - error_floor) / error_floor)
    contradicted = log_ratio * log_odds < 0
    log_odds = jnp.where(contradicted, jnp.clip(log_odds, -bound, bound), log_odds)
    # Motion separates active from inactive, not the active types from each other.
    share = active / jnp.sum(active)
    probability = jax.nn.sigmoid(log_odds + log_ratio)
    return jnp.concatenate([1.0 - probability[None], probability * share])


def _at_least(
    predicted: ContactBelief, before: ContactBelief, least: Float[Array, " E"]
) -> ContactBelief:
    """The prediction, with every edge active at least with the probability ``least``, of the types
    it had before."""
    types = jnp.maximum(before.type_probability[:, 1:], _MIN_PROBABILITY)
    kept = least[:, None] * types / jnp.sum(types, axis=-1, keepdims=True)
    active = predicted.type_probability[:, 1:]
    active = jnp.where(jnp.sum(active, axis=-1, keepdims=True) < least[:, None], kept, active)
    inactive = 1.0 - jnp.sum(active, axis=-1, keepdims=True)
    return ContactBelief(jnp.concatenate([inactive, active], axis=-1))


def _as_if_touching(model: ContactDynamics, state: ModelState, graph: EncodedGraph) -> EncodedGraph:
    """The same step as if bodies touched at their closest approach.

    A network that knows the contact distance does not let an edge act beyond it, even one that is
    active with certainty; both predictions would then be the same motion. The likelihood is that of
    the motion if the edge does act; how probable that is at its distance is part of the belief.
    """
    nearest = _TOUCHING * graph.geometry.closest_approach
    touch = jnp.maximum(model.features.contact_distance, nearest)
    return model.encode(
        state.position, state.velocity, graph.nodes, state.control_displacement, touch
    )


def _most_probable(belief: ContactBelief) -> Float[Array, "E K"]:
    types = belief.type_probability
    return jax.nn.one_hot(jnp.argmax(types, axis=-1), types.shape[-1], dtype=types.dtype)


def _alternative(
    belief: ContactBelief, is_active: Bool[Array, ""], edge: Int[Array, ""]
) -> Float[Array, " K"]:
    """The type compared with an edge's most probable one: inactive, or the likeliest active one."""
    types = belief.type_probability[edge]
    active = 1 + jnp.argmax(types[1:])
    return jax.nn.one_hot(jnp.where(is_active, 0, active), len(types), dtype=types.dtype)


def _nearest(graph: EncodedGraph) -> Int[Array, " considered"]:
    """The edges within the cutoff whose nodes come nearest to each other in the step."""
    near = jnp.where(graph.weight > 0, -graph.geometry.closest_approach, -jnp.inf)
    return jax.lax.top_k(near, min(_CONSIDERED, near.shape[0]))[1]
