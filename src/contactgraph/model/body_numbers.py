"""Numbers of each type of bodies: masses, and laws by which touches and the ground act on it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.model.contacts import MAX_COUPLING

PACE = 5.0
"""Scale of each type's numbers in their parameters, which learn faster than weights by this."""
DECELERATION = 10.0
"""Unit of decelerations by the ground, in units of speed a second."""


class BodyNumbers(eqx.Module):
    """Parameters of the types of a `BodyHead`, and the numbers that they stand for."""

    log_mass: Float[Array, " types"]
    """Of the mass in kg, in units of `PACE`; motion determines masses up to a common factor."""
    damper_raw: Float[Array, " types"]
    """Of the damper to the ground, 1/s: softplus(`PACE` x - 6)."""
    deceleration_raw: Float[Array, " types"]
    """Of the deceleration by the ground, in units of `DECELERATION`: softplus(`PACE` x - 6)."""
    bounce_raw: Float[Array, " types+1"]
    """A touch bounces with sigmoid(`PACE` (x_i + x_j) - 3). The last is that of planes."""
    friction_raw: Float[Array, " types+1"]
    """A touch has the coefficient of friction softplus(`PACE` (x_i + x_j) - 4)."""
    log_inertia: Float[Array, "types ..."] | None
    """Of squared radii of gyration by `turn_length`, in space about axes, over `PACE`; or none."""
    log_spread: Float[Array, " types"] | None
    """Of the spread of log masses in a type, in units of `PACE`, or none."""
    speed: float = eqx.field(static=True)
    turn_length: float | None = eqx.field(static=True)
    told: tuple[str, ...] = eqx.field(static=True)
    """Parameters that trajectories told directly, and that are not learned: gradients through
    impacts are noise, and lead away from them."""

    def slowing(self, node_type: Float[Array, "N types"]) -> tuple[Array, Array]:
        """Damper, 1/s, and deceleration, m/s^2, of every node by the ground."""
        damper, deceleration = (
            jax.nn.softplus(PACE * node_type @ self._learned(name) - 6.0)
            for name in ("damper_raw", "deceleration_raw")
        )
        return damper, DECELERATION * self.speed * deceleration

    def mass(
        self, node_type: Float[Array, "N types"], log_ratio: Float[Array, " N"] | float
    ) -> Float[Array, " N"]:
        """kg, with the logarithm of that in units of the type's own; see `log_mass`."""
        log_mass = self.log_mass
        if self.log_spread is not None:  # learned by what the motion of each body tells
            log_mass = jax.lax.stop_gradient(log_mass)
        return jnp.exp(PACE * node_type @ log_mass + log_ratio)

    def mass_ratio(self, node_type: Float[Array, "N types"], size: int) -> Float[Array, "N G"]:
        """The mass of every coordinate, in units of that of the body."""
        ratio = jnp.ones((len(node_type), size))
        if self.log_inertia is None:
            return ratio
        inertia = jnp.exp(PACE * node_type @ self.log_inertia).reshape(len(node_type), -1)
        return ratio.at[:, size - inertia.shape[1] :].multiply(inertia)

    def laws(
        self,
        node_type: Float[Array, "N types"],
        one: Int[Array, " C"],
        other: Int[Array, " C"] | None = None,
    ) -> tuple[Float[Array, " C"], Float[Array, " C"]]:
        """Bounce and coefficient of friction of touches of nodes with others, or with planes."""

        def both(raw: Float[Array, " types+1"]) -> Float[Array, " C"]:
            each = node_type @ raw[:-1]
            return PACE * (each[one] + (raw[-1] if other is None else each[other]))

        bounce = MAX_COUPLING * jax.nn.sigmoid(both(self._learned("bounce_raw")) - 3.0)
        return bounce, jax.nn.softplus(both(self._learned("friction_raw")) - 4.0)

    def _learned(self, name: str) -> Float[Array, " types"]:
        """The parameter, without a gradient where `told` has it."""
        raw = getattr(self, name)
        return jax.lax.stop_gradient(raw) if name in self.told else raw
