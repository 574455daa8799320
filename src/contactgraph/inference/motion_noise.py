"""Noise of observed and predicted motion, and the likelihood of the types of an edge."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from contactgraph.bodies.graph import EdgeType
from contactgraph.data.errors import InvalidInputError

_LEAST_POSITION, _LEAST_VELOCITY, _LEAST_SHARE = 5e-5, 1e-3, 0.01
"""Least scales, in lengths, lengths a second, and 1. Only the steps that a type explains well count
for its scales, so that without a bound they would shrink, and steps that fit less well drop out."""
_SHARE = 0.4
"""Relative error of the effect of a contact, where it is not learned."""

Motion = tuple[Float[Array, "N D"], Float[Array, "N D"]]
"""Position [m] and velocity [m/s] of every node."""


class MotionNoise(eqx.Module):
    r"""Standard deviations of observations and of predictions.

    For a node whose predicted position and velocity a type changes by $\delta_x$ and $\delta_v$,
    the errors $e_x, e_v$ have the variances

    $$ s_v^2 = 2 \sigma_v^2 + m_v^2 + r^2 \|\delta_v\|^2, \qquad
       s_x^2 = 2 \sigma_x^2 + dt^2 \sigma_v^2 + m_x^2
       + r^2 (\|\delta_x\|^2 + dt^2 \|\delta_v\|^2). $$

    Both observations of a step are noisy, hence the 2. The effect of a contact is predicted up to a
    factor only: the time and size of an impact depend on distances known to a few per cent.

    A node whose predictions for two types differ by no more than the noise, $\|\delta\|^2 / s^2$
    without r at most D, tells nothing about them: the state from which the step is predicted is
    noisy itself, and a contact, which averages over two bodies, would always fit noise a little
    better.

    Raises `InvalidInputError` where a number is negative, or where both observation and model are
    exact.
    """

    position: float = 0.0
    """Of one observed position, on each axis, m."""
    velocity: float = 0.0
    """Of one observed velocity, on each axis, m/s."""
    model_position: float | Float[Array, "*N"] = 5e-4
    """Of a predicted position after one step, m."""
    model_velocity: float | Float[Array, "*N"] = 1e-2
    """Of a predicted velocity after one step, m/s."""
    model_share: float = _SHARE
    """Relative error of the predicted effect of a contact, as far as that tells masses."""
    type_share: float | Float[Array, ""] = _SHARE
    """r; relative error of the predicted effect of a contact."""
    tail: float = eqx.field(static=True, default=4.0)
    """Degrees of freedom of Student's t: the fewer, the less weight has one outlier."""
    max_log_ratio: float = eqx.field(static=True, default=6.0)
    """Bound on the log-likelihood ratio of one step: odds of 400."""

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

    def log_ratios(
        self,
        predictions: Motion,
        observed: Motion,
        exists: Bool[Array, " N"],
        dt: float,
        edge_types: tuple[EdgeType, ...],
    ) -> Float[Array, "K K"]:
        """Log-likelihood of ``observed`` if an edge has type i first and type j in the end.

        Each is less that of the likeliest pair; ``predictions`` [K, ...] are those of a step with
        one type throughout: with none, then with each of the ``edge_types``.
        """
        types, dimension = 1 + len(edge_types), observed[0].shape[-1]
        first, last = (index.ravel() for index in jnp.indices((types, types)))
        closes = first < last
        x, v = predictions
        # A change may come at any time of the step; bodies that meet in it, or are grasped, move in
        # the end as if they always had been.
        middle_x, middle_v = 0.5 * (x[first] + x[last]), 0.5 * (v[first] + v[last])
        middle_v = jnp.where(closes[:, None, None], v[last], middle_v)
        # The effect of a type, beside none, is known up to a share of it.
        effect_v = self.type_share**2 * _square(v, v[0])
        effect_x = self.type_share**2 * _square(x, x[0]) + dt**2 * effect_v
        change_v = _UNIFORM**2 * _square(v[last], v[first])
        change_x = _UNIFORM**2 * _square(x[last], x[first]) + dt**2 * change_v
        base_v = 2.0 * self.velocity**2 + self.model_velocity**2
        base_x = 2.0 * self.position**2 + (dt * self.velocity) ** 2 + self.model_position**2
        variance_x = base_x + 0.5 * (effect_x[first] + effect_x[last]) + change_x
        changing_v = 0.5 * (effect_v[first] + effect_v[last]) + change_v
        variance_v = base_v + jnp.where(closes[:, None], effect_v[last], changing_v)
        middle = middle_x, middle_v
        likelihood = _log_density(observed, middle, variance_x, variance_v, self.tail)
        likelihood = likelihood - 0.5 * dimension * (jnp.log(variance_x) + jnp.log(variance_v))
        # Bodies that meet as geometry foresees move as with that contact throughout, and a hold may
        # end in the last instant.
        pushes = np.array([False, *(each.unilateral for each in edge_types)])
        holds = np.array([False, *(each.holds for each in edge_types)])
        touches = jnp.asarray(pushes)[first]
        throughout_first, throughout_last = first * (types + 1), last * (types + 1)
        second = jnp.where(first == 0, throughout_last, jnp.arange(types**2))
        second = jnp.where(~touches & (first > last), throughout_first, second)
        likelihood = jnp.logaddexp(likelihood, likelihood[second]) - jnp.log(2.0)
        # A hold may begin in the last instant, too, after a touch.
        if pushes.any():
            begins = (touches | (first == 0)) & jnp.asarray(holds)[last]
            touched = jnp.where(begins, first * types + np.argmax(pushes), jnp.arange(types**2))
            likelihood = jnp.logaddexp(likelihood, likelihood[touched]) - jnp.log(2.0)
        likelihood = jnp.where(exists & jnp.isfinite(likelihood), likelihood, 0.0)
        best = jnp.argmax(jnp.sum(likelihood, axis=-1))
        contrast = _square(middle[0], middle[0][best]) / base_x
        contrast = contrast + _square(middle[1], middle[1][best]) / base_v
        # 0 where two predictions differ by no more than the noise
        relevance = 1.0 - dimension / jnp.maximum(contrast, dimension)
        ratio = jnp.sum(relevance * (likelihood - likelihood[best]), axis=-1)
        return jnp.clip(ratio, -self.max_log_ratio, 0.0).reshape(types, types)


_UNIFORM = 12.0**-0.5
"""Standard deviation of a uniform distribution, in units of its width."""
_PACE = 5.0
"""Scale of the logarithms in their parameters, so that they learn as fast as the dynamics."""


class PredictionNoise(eqx.Module):
    r"""Learned errors of a model's predicted step: scales of Student's t.

    Its score is the negative log-likelihood of the residuals of those edge types that the motion
    makes probable, so that both shrink as the dynamics become exact, and evidence sharpens.
    """

    log_position: Float[Array, ""]
    """Logarithm of the scale in m, in units of `_PACE`."""
    log_velocity: Float[Array, ""]
    """The same of the scale in m/s."""

    log_share: Float[Array, ""]
    """The same of the error of a contact's effect, in units of the effect. One for all types: of
    two, one would learn to explain whatever the other does not."""

    length: float = eqx.field(static=True)

    def __init__(self, length: float = 0.1) -> None:
        """``length`` [m] is the unit of the least scales: about the distance of a contact."""
        start, self.length = MotionNoise(), length
        self.log_share = jnp.log(start.model_share) / _PACE * jnp.ones(())
        self.log_position = jnp.log(start.model_position) / _PACE * jnp.ones(())
        self.log_velocity = jnp.log(start.model_velocity) / _PACE * jnp.ones(())

    @property
    def position(self) -> Float[Array, ""]:
        """m, on each axis."""
        return jnp.maximum(jnp.exp(_PACE * self.log_position), _LEAST_POSITION * self.length)

    @property
    def velocity(self) -> Float[Array, ""]:
        """m/s, on each axis."""
        return jnp.maximum(jnp.exp(_PACE * self.log_velocity), _LEAST_VELOCITY * self.length)

    @property
    def share(self) -> Float[Array, ""]:
        """Of a contact's effect."""
        return jnp.maximum(jnp.exp(_PACE * self.log_share), _LEAST_SHARE)

    def score(
        self,
        predicted: Motion,
        unhindered: Motion,
        observed: Motion,
        active: Float[Array, " N"],
        dt: float,
    ) -> Float[Array, " N"]:
        """Negative log-likelihood of every node's residual, up to a constant.

        ``unhindered`` is the prediction without edges, and ``active`` how many act on each node.
        """
        tail, dimension = MotionNoise().tail, observed[0].shape[-1]
        share = self.share**2 * active
        effect_x, effect_v = (_square(*each) for each in zip(predicted, unhindered, strict=True))
        variance_x = self.position**2 + share * (effect_x + dt**2 * effect_v)
        variance_v = self.velocity**2 + share * effect_v
        spread = 0.5 * dimension * (jnp.log(variance_x) + jnp.log(variance_v))
        return spread - _log_density(observed, predicted, variance_x, variance_v, tail)


def in_lengths(noise: PredictionNoise, length: float, like: PredictionNoise) -> PredictionNoise:
    """The noise learned with a unit of ``length`` data units, in these; ``like``: one of those."""
    shift = jnp.log(length) / _PACE
    return eqx.tree_at(
        lambda each: (each.log_position, each.log_velocity, each.log_share),
        like,
        (noise.log_position + shift, noise.log_velocity + shift, noise.log_share),
    )


def _log_density(
    observed: Motion,
    predicted: Motion,
    variance_x: Float[Array, "*K N"],
    variance_v: Float[Array, "*K N"],
    tail: float,
) -> Float[Array, "*K N"]:
    """Of Student's t, of every node; without its normalization, which the variances determine."""
    error = _square(observed[0], predicted[0]) / variance_x
    error = error + _square(observed[1], predicted[1]) / variance_v
    return -0.5 * (tail + 2 * observed[0].shape[-1]) * jnp.log1p(error / tail)


def _square(
    one: Float[Array, "*K N D"], other: Float[Array, "*K N D"] | float
) -> Float[Array, "*K N"]:
    return jnp.sum((one - other) ** 2, axis=-1)
