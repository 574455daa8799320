"""The parameters of one node's local dynamics, and what kind of thing makes them a linear step."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

_SMALLEST = 1e-6


class SpringMassDamper(eqx.Module):
    r"""A mass on a spring and a damper, for every node and degree of freedom on its own.

    $$ \ddot x = w u - \kappa (x - \hat x) - \gamma (v - \hat v), \qquad
       w = 1/m,\ \kappa = k/m,\ \gamma = c/m $$

    Stiffness and damping are kept as rates, so that a body which no control moves ($w = 0$) can
    still be struck. The spring's other end is at $\hat x$, the damper's moves with $\hat v$: with
    $\hat v = 0$ this is the paper's model. `shift` moves the position within the step besides:
    an impact in the middle of a step displaces what it stops.
    """

    inverse_mass: Float[Array, "*T N D"]
    """w, 1/kg."""
    stiffness_rate: Float[Array, "*T N D"]
    """k/m, 1/s^2."""
    damping_rate: Float[Array, "*T N D"]
    """c/m, 1/s."""
    equilibrium: Float[Array, "*T N D"]
    """m; where the spring is at rest."""
    equilibrium_velocity: Float[Array, "*T N D"]
    """m/s; where the damper is at rest."""
    shift: Float[Array, "*T N D"]
    """m; displacement by an impact within the step."""

    @property
    def stiffness(self) -> Float[Array, "*T N D"]:
        """k, N/m: the rate times the mass; large where nothing moves the node."""
        return self.stiffness_rate / jnp.maximum(self.inverse_mass, _SMALLEST)

    @property
    def damping(self) -> Float[Array, "*T N D"]:
        """c, N s/m: the rate times the mass; large where nothing moves the node."""
        return self.damping_rate / jnp.maximum(self.inverse_mass, _SMALLEST)


def from_physical(
    inverse_mass: Float[Array, "*T N D"],
    stiffness: Float[Array, "*T N D"],
    damping: Float[Array, "*T N D"],
    equilibrium: Float[Array, "*T N D"],
) -> SpringMassDamper:
    """The paper's own parameters: 1/m [1/kg], k [N/m], c [N s/m] and equilibrium [m]."""
    still = jnp.zeros_like(equilibrium)
    return SpringMassDamper(
        inverse_mass=inverse_mass,
        stiffness_rate=inverse_mass * stiffness,
        damping_rate=inverse_mass * damping,
        equilibrium=equilibrium,
        equilibrium_velocity=still,
        shift=still,
    )
