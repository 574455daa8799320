"""How far seen motion may be off a prediction, and what that says for one prediction or another."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from contactgraph.data.errors import InvalidInputError

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
    most: float = eqx.field(static=True, default=6.0)
    """Bound on the log-likelihood ratio of one step: odds of 400."""
    doubt: float = eqx.field(static=True, default=0.01)
    """How probable a mistake of the model is taken to be where motion contradicts its belief."""
    lasting: float = eqx.field(static=True, default=5.0)
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
        return jnp.clip(jnp.where(jnp.isfinite(ratio), ratio, 0.0), -self.most, self.most)


def _square(one: Float[Array, "N D"], other: Float[Array, "N D"]) -> Float[Array, " N"]:
    return jnp.sum((one - other) ** 2, axis=-1)
