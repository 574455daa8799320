"""The parameters of one node's local dynamics, and what kind of thing makes them a linear step."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

_SMALLEST = 1e-6


class SpringMassDamper(eqx.Module):
    r"""A mass on a spring and a damper, for every node and degree of freedom on its own.

    $$ \ddot x = w u - \kappa (x - \hat x) - \gamma (v - \hat v) + a, \qquad
       w = 1/m,\ \kappa = k/m,\ \gamma = c/m $$

    Stiffness and damping are kept as rates, so that a body which no control moves ($w = 0$) can
    still be struck. The spring's other end is at $\hat x$, the damper's moves with $\hat v$: with
    $\hat v = 0$ this is the paper's model. `shift` moves the position within the step besides:
    an impact in the middle of a step displaces what it stops.
    """

    response: Float[Array, "*T N D U"]
    """w, 1/kg: acceleration by each component of the control. Off its diagonal only where a
    hinge turns a push."""
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
    acceleration: Float[Array, "*T N D"] | None = None
    """a, m/s^2, by forces that depend on nothing here, such as weight. None: there are none."""

    @property
    def inverse_mass(self) -> Float[Array, "*T N D"]:
        """1/m, 1/kg: the response of each degree of freedom to its own component of the control."""
        dimension, size = self.response.shape[-2:]
        own = jnp.diagonal(self.response, axis1=-2, axis2=-1)
        return jnp.pad(own, [(0, 0)] * (own.ndim - 1) + [(0, dimension - min(dimension, size))])

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
    """The paper's own parameters: 1/m [1/kg], k [N/m], c [N s/m] and equilibrium [m].

    Component d of the control acts on degree of freedom d.
    """
    still = jnp.zeros_like(equilibrium)
    return SpringMassDamper(
        response=own_component(inverse_mass, inverse_mass.shape[-1]),
        stiffness_rate=inverse_mass * stiffness,
        damping_rate=inverse_mass * damping,
        equilibrium=equilibrium,
        equilibrium_velocity=still,
        shift=still,
    )


def own_component(
    inverse_mass: Float[Array, "*T N D"], control_size: int
) -> Float[Array, "*T N D U"]:
    """The response of degrees of freedom that component d of the control moves along d alone."""
    dimension = inverse_mass.shape[-1]
    return inverse_mass[..., None] * jnp.eye(dimension, control_size, dtype=inverse_mass.dtype)
