"""From spring, mass and damper to one linear step: stable by construction for theta >= 1/2."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.data.errors import InvalidInputError
from contactgraph.model.linear_dynamics import LinearDynamics
from contactgraph.model.spring_mass_damper import SpringMassDamper


class ThetaMethod(eqx.Module):
    r"""One step of the theta method; `docs/stability.md` derives it.

    $\theta = 0$ is explicit Euler, the paper's own matrices, which are *not* stable for all
    positive parameters; every $\theta \ge 1/2$ is. A simulator with $n$ symplectic substeps moves
    a body under constant force exactly as $\theta = (n+1)/2n$.
    """

    initial: float = eqx.field(static=True)
    learned: bool = eqx.field(static=True)
    raw: Float[Array, ""]

    def __init__(self, initial: float = 0.55, learned: bool = True):
        """Start at theta `initial`; keep it fixed, or learn it within (1/2, 1)."""
        if learned and not 0.5 < initial < 1.0:
            raise InvalidInputError(f"a learned theta must start within (0.5, 1), found {initial}")
        if not 0.0 <= initial <= 1.0:
            raise InvalidInputError(f"theta must lie in [0, 1], found {initial}")
        self.initial = initial
        self.learned = learned
        fraction = 2.0 * initial - 1.0 if learned else 0.5
        self.raw = jnp.log(fraction / (1.0 - fraction)) * jnp.ones(())

    @property
    def theta(self) -> Float[Array, ""]:
        """The implicitness, in [0, 1]."""
        if not self.learned:
            return jnp.full_like(self.raw, self.initial)
        return 0.5 + 0.5 * jax.nn.sigmoid(self.raw)

    def __call__(self, parameters: SpringMassDamper, dt: float) -> LinearDynamics:
        """``A [N, D, 2, 2]``, ``B [N, D, 2, U]`` and ``offset [N, D, 2]`` of a step of `dt` [s]."""
        theta = self.theta
        explicit = 1.0 - theta
        spring = parameters.stiffness_rate * dt
        damper = parameters.damping_rate * dt
        den = 1.0 + theta * damper + theta**2 * spring * dt
        A21 = -spring / den
        A22 = (1.0 - explicit * damper - theta * explicit * spring * dt) / den
        A11 = 1.0 + theta * dt * A21
        A12 = dt * (explicit + theta * A22)
        B2 = parameters.response * dt / den[..., None]
        pull = spring * parameters.equilibrium + damper * parameters.equilibrium_velocity
        if parameters.acceleration is not None:
            pull = pull + dt * parameters.acceleration
        offset2 = pull / den
        A = jnp.stack([jnp.stack([A11, A12], -1), jnp.stack([A21, A22], -1)], -2)
        B = jnp.stack([theta * dt * B2, B2], -2)
        offset = jnp.stack([theta * dt * offset2 + parameters.shift, offset2], -1)
        return LinearDynamics(A=A, B=B, offset=offset)
