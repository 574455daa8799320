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
from contactgraph.dynamics.linear_dynamics import LinearDynamics, SpringMassDamper


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

    def retract(
        self,
        graph: EncodedGraph,
        position: Float[Array, "N G"],
        velocity: Float[Array, "N G"],
        **step: Any,
    ) -> tuple[Float[Array, "N G"], Float[Array, "N G"]]:
        """See `ContactLaw.retract`: as they are."""
        return position, velocity


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

    def retract(
        self,
        graph: EncodedGraph,
        position: Float[Array, "N G"],
        velocity: Float[Array, "N G"],
        **step: Any,
    ) -> tuple[Float[Array, "N G"], Float[Array, "N G"]]:
        """See `ContactLaw.retract`."""
        theta = self.discretization.theta
        return self.head.retract(graph, position, velocity, theta=theta, **step)
