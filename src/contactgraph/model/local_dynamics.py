"""Local dynamics: from the cut graph to one linear step of every node, by the theta method."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.data.errors import InvalidInputError
from contactgraph.model.collision import Geometry, geometry
from contactgraph.model.contact_law import ContactLaw
from contactgraph.model.features import Features
from contactgraph.model.message_passing import TypedMessagePassing
from contactgraph.model.shapes import Meeting
from contactgraph.model.types import LinearDynamics, LocalInput, Nodes, SpringMassDamper, Step


def step_geometry(
    features: Features,
    dynamics: "LocalDynamics",
    state: tuple[Float[Array, "N G"], Float[Array, "N G"]],
    nodes: Nodes,
    edge_index: Int[Array, "2 E"],
    dt: float,
    contact_distance: Float[Array, "*E"] | float,
    meeting: Meeting | None,
    control_displacement: Float[Array, "N G"] | None = None,
) -> Geometry:
    """The places at which the nodes of edges meet in a step of ``dt`` [s] from a ``state`` of
    positions [m] and velocities [m/s]: see `EncodedGraph.contact_points`."""
    position, velocity = state
    if meeting is not None:
        count = meeting.edge_index.shape[1] // max(1, edge_index.shape[1])
        each = jnp.broadcast_to(contact_distance, edge_index.shape[1:])
        contact_distance = jnp.tile(each, count)
    static = nodes.static if features.types else None  # not known without types
    known = control_displacement, nodes.anchor, static, features.speed, nodes.half_size
    head, coasting = getattr(dynamics, "head", None), None
    if isinstance(head, ContactLaw):
        types = features.node_type(nodes, velocity.dtype)
        turns = features.turns(nodes, velocity.dtype)
        coasting = head.coasting(position, velocity, types, nodes, turns, dt)
    at = position, velocity, edge_index, dt, contact_distance
    return geometry(*at, *known, meeting, coasting)


def in_substeps(
    features: Features,
    dynamics: "LocalDynamics",
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
        part = edges.edge_index, dt, edges.contact_distance, meeting
        found = step_geometry(features, dynamics, at, local.nodes, *part)
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


class LocalDynamics(eqx.Module):
    """One linear step of every node, given the active edges."""

    message_passing: eqx.AbstractVar[Any]
    axis_aligned: bool = eqx.field(static=True, default=True, kw_only=True)
    """Whether component d of the control moves degree of freedom d, and further ones nothing."""

    @abstractmethod
    def __call__(self, local: LocalInput, dt: float, control_size: int) -> LinearDynamics:
        """The linear step of `dt` [s] of every node."""


class SpringMassDamperDynamics(LocalDynamics):
    """Messages over the active edges, then a spring-mass-damper for every node, then one step."""

    message_passing: TypedMessagePassing
    head: Callable[..., SpringMassDamper]
    """Messages to parameters of every node, such as a `ContactLaw`."""
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
