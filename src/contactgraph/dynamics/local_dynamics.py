"""Local dynamics: from the cut graph to one linear step of every node, by the theta method."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.graph import Bodies, EncodedGraph
from contactgraph.bodies.message_passing import TypedMessagePassing
from contactgraph.data.errors import InvalidInputError


class LinearDynamics(eqx.Module):
    """``x' = A x + B u + offset`` of one step, separately for every node and degree of freedom.

    ``x = [position, velocity]`` of one degree of freedom [m, m/s]; ``u`` [N] acts on every node.
    """

    A: Float[Array, "*T N D 2 2"]
    B: Float[Array, "*T N D 2 U"]
    offset: Float[Array, "*T N D 2"]

    def __call__(
        self,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        control: Float[Array, " U"],
    ) -> tuple[Float[Array, "N D"], Float[Array, "N D"]]:
        """Next position [m] and velocity [m/s]."""
        moved = jnp.sum(self.A * jnp.stack([position, velocity], axis=-1)[..., None, :], axis=-1)
        moved = moved + jnp.sum(self.B * control, axis=-1) + self.offset
        return moved[..., 0], moved[..., 1]

    def then(self, after: "LinearDynamics") -> "LinearDynamics":
        """This step and the one after it, as one."""
        return LinearDynamics(
            A=jnp.sum(after.A[..., None] * self.A[..., None, :, :], axis=-2),
            B=jnp.sum(after.A[..., None] * self.B[..., None, :, :], axis=-2) + after.B,
            offset=jnp.sum(after.A * self.offset[..., None, :], axis=-1) + after.offset,
        )

    def stacked(self) -> tuple[Array, Array, Array]:
        """Dense ``A [2ND, 2ND]``, ``B [2ND, U]``, ``offset [2ND]`` in `stack_state`'s order."""
        *lead, nodes, dimension = self.A.shape[:-2]
        size = 2 * nodes * dimension
        node, dof, row, column = jnp.ogrid[:nodes, :dimension, :2, :2]
        first = (node * 2 + row) * dimension + dof
        second = (node * 2 + column) * dimension + dof
        A = jnp.zeros((*lead, size, size), self.A.dtype).at[..., first, second].set(self.A)
        B = jnp.swapaxes(self.B, -3, -2).reshape(*lead, size, self.B.shape[-1])
        offset = jnp.swapaxes(self.offset, -2, -1).reshape(*lead, size)
        return A, B, offset


def stack_state(
    position: Float[Array, "*T N D"], velocity: Float[Array, "*T N D"]
) -> Float[Array, "*T 2*N*D"]:
    """One vector ``[2ND]``: for each node its D positions [m], then its D velocities [m/s]."""
    both = jnp.stack([position, velocity], axis=-2)
    return both.reshape(*position.shape[:-2], -1)


class SpringMassDamper(eqx.Module):
    r"""A mass on a spring and a damper, separately for every node and degree of freedom.

    $$ \ddot x = w u - \kappa (x - \hat x) - \gamma (v - \hat v) + a, \qquad
       w = 1/m,\ \kappa = k/m,\ \gamma = c/m $$

    Stiffness and damping are rates, so that a body that no control moves ($w = 0$) still responds
    to impacts. The spring's other end is at $\hat x$, the damper's moves with $\hat v$; with
    $\hat v = 0$ this is the paper's model. `impact_displacement` is added to the position, because
    an impact in the middle of a step displaces the body that it stops.
    """

    response: Float[Array, "*T N D U"]
    """w, 1/kg: acceleration by each component of the control. Off its diagonal only where a
    hinge turns the force."""
    stiffness_rate: Float[Array, "*T N D"]
    """k/m, 1/s^2."""
    damping_rate: Float[Array, "*T N D"]
    """c/m, 1/s."""
    equilibrium: Float[Array, "*T N D"]
    """m; where the spring is at rest."""
    equilibrium_velocity: Float[Array, "*T N D"]
    """m/s; where the damper is at rest."""
    impact_displacement: Float[Array, "*T N D"]
    """m; by an impact within the step."""
    acceleration: Float[Array, "*T N D"]
    """a, m/s^2, by constant forces such as weight."""

    @property
    def inverse_mass(self) -> Float[Array, "*T N D"]:
        """1/m, 1/kg: the response of each degree of freedom to its own component of the control."""
        dimension, size = self.response.shape[-2:]
        own = jnp.diagonal(self.response, axis1=-2, axis2=-1)
        return jnp.pad(own, [(0, 0)] * (own.ndim - 1) + [(0, dimension - min(dimension, size))])


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
        impact_displacement=still,
        acceleration=still,
    )


def own_component(
    inverse_mass: Float[Array, "*T N D"], control_size: int
) -> Float[Array, "*T N D U"]:
    """The response of degrees of freedom of which component d of the control moves the d-th only.

    Components beyond the degrees of freedom move nothing.
    """
    dimension = inverse_mass.shape[-1]
    return inverse_mass[..., None] * jnp.eye(dimension, control_size, dtype=inverse_mass.dtype)


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
        offset2 = (pull + dt * parameters.acceleration) / den
        A = jnp.stack([jnp.stack([A11, A12], -1), jnp.stack([A21, A22], -1)], -2)
        B = jnp.stack([theta * dt * B2, B2], -2)
        offset = jnp.stack([theta * dt * offset2 + parameters.impact_displacement, offset2], -1)
        return LinearDynamics(A, B, offset)


class WithoutContacts(eqx.Module):
    """What local dynamics, or their heads, answer that know of no contact within a step."""

    def coasting(self, bodies: Bodies, dt: float) -> Float[Array, "N G"]:
        """Velocity of every node, m/s, after a step of ``dt`` [s] in which nothing acts on it."""
        return bodies.velocity

    def control_displacement(self, *given: Any, **step: Any) -> Float[Array, "N G"] | None:
        """See `ContactLaw.control_displacement`; None: it is left out of account."""
        return None

    def retract(self, before: Bodies, after: Bodies, **step: Any) -> Bodies:
        """Returns ``after`` unchanged; see `ContactLaw.retract`."""
        return after


class LocalDynamics(WithoutContacts):
    """One linear step of every node, given the active edges."""

    message_passing: eqx.AbstractVar[Any]
    axis_aligned: bool = eqx.field(static=True, default=True, kw_only=True)
    """Whether component d of the control moves degree of freedom d, and further ones nothing."""

    @abstractmethod
    def __call__(self, graph: EncodedGraph, dt: float) -> LinearDynamics:
        """The linear step of `dt` [s] of every node."""

    def parameters(self, graph: EncodedGraph, dt: float) -> SpringMassDamper:
        """Those of every node at one step of `dt` [s]; `TypeError` where there are none."""
        raise TypeError(f"{type(self).__name__} has no spring-mass-damper")


class SpringMassDamperDynamics(LocalDynamics):
    """Messages over the active edges, then a spring-mass-damper for every node, then one step."""

    message_passing: TypedMessagePassing
    head: Any
    """Messages to parameters of every node, such as a `ContactLaw`."""
    discretization: ThetaMethod

    def parameters(self, graph: EncodedGraph, dt: float) -> SpringMassDamper:
        """The parameters of every node at one step of `dt` [s], each [N, D]."""
        embedding, message = self.message_passing(
            graph.node_features, graph.edge_features, graph.active, graph.geometry.edge_index
        )
        return self.head(graph, embedding, message, theta=self.discretization.theta, dt=dt)

    def __call__(self, graph: EncodedGraph, dt: float) -> LinearDynamics:
        """The linear step of every node."""
        return self.discretization(self.parameters(graph, dt), dt)

    def coasting(self, bodies: Bodies, dt: float) -> Float[Array, "N G"]:
        """See `ContactLaw.coasting`."""
        return self.head.coasting(bodies, dt)

    def control_displacement(self, *step: Any, **further: Any) -> Float[Array, "N G"] | None:
        """See `ContactLaw.control_displacement`."""
        return self.head.control_displacement(*step, **further, theta=self.discretization.theta)

    def retract(self, before: Bodies, after: Bodies, **step: Any) -> Bodies:
        """See `ContactLaw.retract`."""
        return self.head.retract(before, after, theta=self.discretization.theta, **step)
