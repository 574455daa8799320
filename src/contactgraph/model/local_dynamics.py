"""Local dynamics: from the cut graph to one linear step of every node, by the theta method."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from contactgraph.bodies.geometry import Geometry, geometry
from contactgraph.bodies.shapes import Meeting
from contactgraph.data.errors import InvalidInputError
from contactgraph.model.contact_law import ContactLaw
from contactgraph.model.features import AbsoluteFeatures, InvariantFeatures
from contactgraph.model.heads import PerDegreeHead
from contactgraph.model.message_passing import TypedMessagePassing
from contactgraph.model.types import LinearDynamics, LocalInput, Nodes, SpringMassDamper, Step


def step_geometry(
    features: InvariantFeatures | AbsoluteFeatures,
    dynamics: "SpringMassDamperDynamics | FreeLinearDynamics",
    nodes: Nodes,
    meeting: Meeting,
    *,
    position: Float[Array, "N G"],
    velocity: Float[Array, "N G"],
    dt: float,
    contact_distance: Float[Array, "*E"] | float,
    control_displacement: Float[Array, "N G"] | None = None,
) -> Geometry:
    """The geometry of a ``meeting`` in a step of ``dt`` [s] from a ``position`` [m] at ``velocity``
    [m/s]: see `EncodedGraph.contact_points`. Each edge has its own ``contact_distance`` [m]."""
    head, coasting = getattr(dynamics, "head", None), None
    if isinstance(head, ContactLaw):
        types = features.node_type(nodes, velocity.dtype)
        turns = features.turns(nodes, velocity.dtype)
        coasting = head.coasting(position, velocity, types, nodes, turns, dt)
    return geometry(
        meeting,
        velocity=velocity,
        dt=dt,
        contact_distance=jnp.resize(contact_distance, meeting.edge_index.shape[1:]),
        control_displacement=control_displacement,
        coasting=coasting,
        speed=features.speed,
    )


def in_substeps(
    features: InvariantFeatures | AbsoluteFeatures,
    dynamics: "SpringMassDamperDynamics | FreeLinearDynamics",
    local: LocalInput,
    dt: float,
    control_size: int,
    count: int,
) -> LinearDynamics:
    """A step of ``dt`` [s] in ``count`` parts, each from where those before lead without control.

    The active edges, and the messages along them, are those of the step. No gradient flows through
    the beginnings of the parts.
    """
    if count == 1:
        return dynamics(local, dt, control_size)
    edges, dt = local.geometry, dt / count

    def part(done: LinearDynamics, _: None) -> tuple[LinearDynamics, None]:
        at = done(local.position, local.velocity, jnp.zeros(done.B.shape[-1], done.B.dtype))
        # Through all contacts of a rollout, each of which begins within a hair, gradients overflow.
        at = jax.lax.stop_gradient(at)
        meeting = features.meeting(local.nodes, at[0], edges.edge_index)
        found = step_geometry(
            features,
            dynamics,
            local.nodes,
            meeting,
            position=at[0],
            velocity=at[1],
            dt=dt,
            contact_distance=edges.contact_distance,
        )
        there = dataclasses.replace(
            local,
            position=at[0],
            velocity=at[1],
            geometry=found.first(len(local.weight)),
            points=found,
            control_displacement=None,
        )
        return done.then(dynamics(there, dt, control_size)), None

    shapes = jax.eval_shape(lambda local: dynamics(local, dt, control_size), local)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    first = dataclasses.replace(nothing, A=nothing.A + jnp.eye(2, dtype=nothing.A.dtype))
    return jax.lax.scan(part, first, length=count)[0]


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
        free = parameters.unhindered_response
        unhindered = None if free is None else theta * dt**2 * free
        return LinearDynamics(A, B, offset, unhindered, pins=parameters.pins)


class SpringMassDamperDynamics(eqx.Module):
    """Messages over the active edges, then a spring-mass-damper for every node, then one step."""

    message_passing: TypedMessagePassing
    head: ContactLaw | PerDegreeHead
    discretization: ThetaMethod

    def parameters(self, local: LocalInput, dt: float, control_size: int) -> SpringMassDamper:
        """The parameters of every node at one step of `dt` [s], each [N, D]."""
        embedding, message = self.message_passing(
            local.node_features, local.edge_features, local.weight, local.geometry.edge_index
        )
        step = Step(self.discretization.theta, dt, control_size)
        return self.head(local, embedding, message, step)

    def __call__(self, local: LocalInput, dt: float, control_size: int) -> LinearDynamics:
        """The linear step of every node."""
        linear = self.discretization(self.parameters(local, dt, control_size), dt)
        if local.position.shape[1] != 6:
            return linear
        turn_length = getattr(self.head, "turn_length", None)  # of bodies that turn in space
        return dataclasses.replace(linear, turn_length=turn_length)


class FreeLinearDynamics(eqx.Module):
    """Messages over the active edges, then free matrices for every node (the paper's Full-AB).

    Nothing keeps these stable; they serve as a comparison.
    """

    message_passing: TypedMessagePassing
    head: eqx.nn.MLP
    dimension: int = eqx.field(static=True)
    control_size: int = eqx.field(static=True)

    def __init__(
        self,
        message_passing: TypedMessagePassing,
        *,
        dimension: int,
        control_size: int,
        key: PRNGKeyArray,
    ):
        width = message_passing.width
        self.message_passing = message_passing
        self.head = eqx.nn.MLP(width, dimension * (6 + 2 * control_size), width, 2, key=key)
        self.dimension = dimension
        self.control_size = control_size

    def __call__(self, local: LocalInput, dt: float, control_size: int) -> LinearDynamics:
        """The linear step of every node: the identity plus the network's output times dt."""
        embedding, _ = self.message_passing(
            local.node_features, local.edge_features, local.weight, local.geometry.edge_index
        )
        out = jax.vmap(self.head)(embedding)
        out = out.reshape(-1, self.dimension, 2, 3 + self.control_size)
        A = jnp.eye(2, dtype=out.dtype) + dt * out[..., :2]
        return LinearDynamics(A=A, B=dt * out[..., 3:], offset=dt * out[..., 2])
