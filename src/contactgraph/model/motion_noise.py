"""Noise of observed and predicted motion, and the likelihood ratio of two predictions."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from contactgraph.data.errors import InvalidInputError

_LEAST_POSITION, _LEAST_VELOCITY = 1e-6, 1e-5
"""Least scales, m and m/s: rounding of observations in single precision."""

Motion = tuple[Float[Array, "N D"], Float[Array, "N D"]]
"""Position [m] and velocity [m/s] of every node."""


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
    model_position: float | Float[Array, ""] = 5e-4
    """Of a predicted position after one step, m."""
    model_velocity: float | Float[Array, ""] = 1e-2
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

    def log_ratios(
        self, predictions: Motion, observed: Motion, exists: Bool[Array, " N"], dt: float
    ) -> Float[Array, " K"]:
        """Log-likelihood of ``observed`` under K predictions, each less that of the likeliest.

        Predictions are compared in pairs, because the variances are those of a pair.
        """

        def against(other: Motion) -> Float[Array, " K"]:
            return jax.vmap(lambda one: self.log_ratio(one, other, observed, exists, dt))(
                predictions
            )

        ratio = jax.vmap(against)(predictions)  # [other, one]
        likeliest = jnp.argmin(jnp.max(ratio, axis=1))
        return jnp.clip(ratio[likeliest], -self.max_log_ratio, 0.0)

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
        return jnp.where(jnp.isfinite(ratio), ratio, 0.0)


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

    def __init__(self) -> None:
        start = MotionNoise()
        self.log_position = jnp.log(start.model_position) / _PACE * jnp.ones(())
        self.log_velocity = jnp.log(start.model_velocity) / _PACE * jnp.ones(())

    @property
    def position(self) -> Float[Array, ""]:
        """m, on each axis."""
        return jnp.maximum(jnp.exp(_PACE * self.log_position), _LEAST_POSITION)

    @property
    def velocity(self) -> Float[Array, ""]:
        """m/s, on each axis."""
        return jnp.maximum(jnp.exp(_PACE * self.log_velocity), _LEAST_VELOCITY)

    def score(self, predicted: Motion, observed: Motion) -> Float[Array, " N"]:
        """Negative log-likelihood of every node's residual, up to a constant."""
        tail, dimension = MotionNoise().tail, observed[0].shape[-1]
        position, velocity = self.position, self.velocity
        error = _square(observed[0], predicted[0]) / position**2
        error = error + _square(observed[1], predicted[1]) / velocity**2
        spread = 0.5 * (tail + 2 * dimension) * jnp.log1p(error / tail)
        return spread + dimension * (jnp.log(position) + jnp.log(velocity))


def _square(one: Float[Array, "N D"], other: Float[Array, "N D"]) -> Float[Array, " N"]:
    return jnp.sum((one - other) ** 2, axis=-1)
