"""Actuation: how the control drives the actuated bodies."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from contactgraph.bodies.graph import Bodies, EncodedGraph
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.dynamics.free_bodies import ContactMotion
from contactgraph.dynamics.local_dynamics import SpringMassDamper

_MOST_DAMPED = 0.99
"""Of a velocity in a step: the share that a damper may take. What is beyond moves its other end."""
_IMPACT_SPEED = 0.1
"""Change of velocity, in units of speed, from about which a step counts as an impact."""
_SMALL = 1e-6


@dataclass(frozen=True)
class ActuationFit:
    r"""Coefficients of a type's free motion, $\dot v = G u + b - k x - c v$, in implicit steps."""

    matrix: np.ndarray
    """[D, U] G, m/s^2 a unit of the control, for those of its components that drive bodies."""
    bias: np.ndarray
    """[D] b, m/s^2."""
    stiffness: float
    """k, 1/s^2; 0 where the control is relative to the body."""
    damping: float
    """c, 1/s."""
    residual: float
    """m/s; root mean square of what the kept steps leave unexplained of the velocity."""

    def __str__(self) -> str:
        """What drives the type, in a line."""
        kind = "force"
        if self.stiffness:
            kind = f"servo to a target, k {self.stiffness:.3g} 1/s^2, c {self.damping:.3g} 1/s"
        elif self.damping:
            kind = f"servo relative to the body, c {self.damping:.3g} 1/s"
        return f"{kind}, fits to {1e3 * self.residual:.2g} mm/s"


class ActuatedMotion(eqx.Module):
    """The actuation of every node in a step; zero for nodes that are not actuated."""

    inertia: Float[Array, " N"]
    """n, by which the servo multiplies the mass of its body; 1 without one."""
    by_control: Float[Array, "N G U"]
    """Acceleration of the free body for each component of the control, m/s^2 a unit."""
    constant: Float[Array, "N D"]
    """Acceleration of the free body without control, m/s^2."""
    stiffness: Float[Array, " N"]
    """k / n, 1/s^2: by how much a metre of displacement accelerates the free body."""
    damping: Float[Array, " N"]
    """(c + theta dt k) / n, 1/s: the same of a velocity of 1 m/s."""

    def stopped_at_reach(
        self, driven: Float[Array, "N D"], graph: EncodedGraph, *, theta: Array, dt: float
    ) -> tuple["ActuatedMotion", Float[Array, "N D"], EncodedGraph]:
        """The motion of actuators that stop at the bounds of their reach, what they then add to the
        velocity in the step (``driven`` [m/s] without bounds), and the input with nodes braked.

        Where a node would leave its reach, the control has no effect along that axis: the node
        comes to the bound in the step, and does not turn back. Contacts meet it braked, so that
        they add no energy.
        """
        velocity = graph.bodies.velocity
        end = graph.bodies.position + dt * (velocity + theta * driven)
        stop = within_reach(end, graph)
        leaves = end != stop
        after = velocity + ((stop - graph.bodies.position) / dt - velocity) / theta
        after = jnp.where((end - stop) * after > 0.0, after, 0.0)
        slower = jnp.where(leaves & (jnp.abs(after) < jnp.abs(velocity)), after, velocity)
        driven = jnp.where(leaves, after - slower, driven)
        stopped = dataclasses.replace(
            self,
            by_control=jnp.where(leaves[..., None], 0.0, self.by_control),
            constant=jnp.where(leaves, driven / dt, self.constant),
        )
        change = graph.contact_points.relative((slower - velocity)[..., None])[..., 0]
        relative = graph.contact_points.relative_velocity + change
        braked = dataclasses.replace(
            graph,
            bodies=graph.bodies._replace(velocity=slower),
            contact_points=dataclasses.replace(graph.contact_points, relative_velocity=relative),
        )
        return stopped, driven, braked

    def kept_within_reach(
        self,
        solution: ContactMotion,
        driven: Float[Array, "N D"],
        slots: Float[Array, "N S"],
        graph: EncodedGraph,
        braked: EncodedGraph,
        *,
        theta: Array,
        dt: float,
    ) -> ContactMotion:
        """The motion of all nodes, also as ``graph`` [m/s] is braked, and displaced so that none
        ends outside its reach: a fast node does not stop at once, and others may push it."""
        slowing = solution.acceleration + (braked.bodies.velocity - graph.bodies.velocity) / dt
        change = solution.velocity_change + dt * slowing
        change = change + solution.response @ (slots.T @ driven).reshape(-1)
        displaced = solution.impact_displacement
        end = graph.bodies.position + dt * (graph.bodies.velocity + theta * change) + displaced
        displaced = displaced + (within_reach(end, graph) - end)
        return dataclasses.replace(solution, acceleration=slowing, impact_displacement=displaced)

    def parameters(
        self,
        graph: EncodedGraph,
        slots: Float[Array, "N S"],
        solution: ContactMotion,
        *,
        theta: Array,
        dt: float,
        speed: float,
    ) -> SpringMassDamper:
        """The solution as a spring-mass-damper of every node, which `ThetaMethod` steps to it.

        ``speed``: unit of speeds, m/s.
        """
        count, coordinates = graph.bodies.position.shape
        change, response = solution.velocity_change, solution.response
        dimension = response.shape[-1] // slots.shape[1]
        by_control = jnp.einsum("ns,ndu->sdu", slots, self.by_control[:, :dimension])
        by_control = by_control.reshape(slots.shape[1] * dimension, by_control.shape[-1])
        by_control = jnp.pad(
            by_control, ((0, 0), (0, graph.control.shape[0] - by_control.shape[-1]))
        )
        constant = (slots.T @ self.constant)[:, :dimension].reshape(-1)
        # What an actuated body carries moves with it: of the servo's spring and damper a node has
        # the share of its response, relative to its own position and velocity.
        share = response.reshape(count, coordinates, slots.shape[1], dimension)[:, :dimension]
        share = jnp.einsum("ndsd->ns", share) / dimension
        moves = jnp.arange(coordinates) < dimension
        spring = dt**2 * (share @ (slots.T @ self.stiffness))[:, None] * moves
        size = jnp.sqrt(jnp.sum((change / speed) ** 2, axis=-1, keepdims=True) + _SMALL**2)
        impact = (1.0 - solution.own_share) * size / (size + _IMPACT_SPEED)
        damper = dt * (share @ (slots.T @ self.damping))[:, None] * moves
        damper = damper + solution.ground_share + impact
        # An implicit spring damps by itself, which `ActuatedMotion.damping` includes.
        damper = jnp.clip(damper - theta * spring, 0.0, _MOST_DAMPED - theta * spring)
        # Dampers and springs slow the other forces too, but the solution includes the slowing.
        undamped = 1.0 / (1.0 - theta * damper - theta**2 * spring)
        return SpringMassDamper(
            response=(response @ by_control) * undamped[..., None],
            stiffness_rate=undamped * spring / dt**2,
            damping_rate=undamped * damper / dt,
            equilibrium=graph.bodies.position + theta * dt * graph.bodies.velocity,
            equilibrium_velocity=graph.bodies.velocity,
            impact_displacement=solution.impact_displacement,
            acceleration=(response @ constant + solution.acceleration + change / dt) * undamped,
        )


def actuated_slots(nodes: Nodes, slots: int) -> Float[Array, "N slots"]:
    """One-hot: which of the actuated nodes each one is; 0 for others."""
    index = jnp.cumsum(nodes.actuated) - 1
    return jax.nn.one_hot(jnp.where(nodes.actuated, index, -1), slots)


def within_reach(end: Float[Array, "N D"], graph: EncodedGraph) -> Float[Array, "N D"]:
    """The place, m, nearest to the ``end`` of a step that is in a node's reach, or not farther
    outside than the node is."""
    bounds, position = jnp.asarray(graph.bodies.nodes.reach), graph.bodies.position
    turn = ((0, 0), (0, 0), (0, position.shape[1] - bounds.shape[2]))
    bounds = jnp.pad(bounds, turn, constant_values=jnp.nan)
    low = jnp.where(jnp.isnan(bounds[:, 0]), -jnp.inf, jnp.minimum(bounds[:, 0], position))
    high = jnp.where(jnp.isnan(bounds[:, 1]), jnp.inf, jnp.maximum(bounds[:, 1], position))
    return jnp.clip(end, low, high)


class Actuation(eqx.Module):
    r"""Acceleration of each actuated type, affine in the control: a force, or a servo to a target.

    A free body of the type accelerates by

    $$ \dot v = G u + b - k x - c v, $$

    with u those of the first `control_size` components of the control that act on it; further ones
    are commands. A force has k = c = b = 0. A position target has k > 0 and G = k I; a displacement
    or a velocity has k = 0, so that nothing depends on where the body is. The step of dt is
    implicit,

    $$ w = (G u + b - k (x + \theta\,dt\,v) - c v) / n, \qquad
       n = 1 + \theta c\,dt + \theta^2 k\,dt^2, \qquad v' = v + dt\,w . $$

    What contacts hinder is this motion, of a body of n times its mass: however stiff the servo, the
    step is stable, and a stiff servo pushes and is hardly pushed.
    """

    matrix: Float[Array, "types D U"]
    """G, in units of `scale`."""
    bias: Float[Array, "types D"]
    """b, in units of `scale`."""
    stiffness_root: Float[Array, " types"]
    """Root of k, 1/s."""
    damping_root: Float[Array, " types"]
    """Root of c, s^(-1/2)."""
    types: int = eqx.field(static=True)
    dimension: int = eqx.field(static=True)
    control_size: int = eqx.field(static=True)
    servo: bool = eqx.field(static=True)
    """Whether there are k, c and b; else they are 0."""
    scale: float = eqx.field(static=True)
    """m/s^2; about the greatest acceleration by a unit of control."""

    def __init__(
        self,
        types: int,
        dimension: int,
        control_size: int,
        *,
        servo: bool = False,
        scale: float = 1.0,
    ) -> None:
        """Component d of the control accelerates degree of freedom d by ``scale`` a unit."""
        # Products have no weak type, with which the first training update would recompile.
        own = jnp.eye(dimension, control_size)
        self.matrix = jnp.broadcast_to(own, (types, dimension, control_size)) * jnp.ones(())
        self.bias = 0.0 * jnp.ones((types, dimension))
        self.stiffness_root, self.damping_root = 0.0 * jnp.ones(types), 0.0 * jnp.ones(types)
        self.types, self.dimension, self.control_size = types, dimension, control_size
        self.servo, self.scale = servo, scale

    @property
    def by_servo(self) -> Bool[Array, " types"]:
        """The types that a servo moves, and no mere force."""
        return self.stiffness_root + self.damping_root > 0.0

    @classmethod
    def from_fits(
        cls,
        types: Sequence[str],
        dimension: int,
        control_size: int,
        fits: Mapping[str, ActuationFit],
    ) -> "Actuation":
        """What least squares say of each type's own motion."""
        servo = any(fit.damping or fit.stiffness for fit in fits.values())
        scale = max((float(abs(fit.matrix).max(initial=0.0)) for fit in fits.values()), default=0.0)
        scale = scale or 1.0
        fresh = cls(len(types), dimension, control_size, servo=servo, scale=scale)
        matrix, bias = np.array(fresh.matrix), np.array(fresh.bias)
        stiffness, damping = np.zeros(len(types)), np.zeros(len(types))
        for index, fit in ((types.index(name), fit) for name, fit in fits.items()):
            matrix[index], bias[index] = fit.matrix / scale, fit.bias / scale * servo
            stiffness[index], damping[index] = fit.stiffness, fit.damping
        leaves = [matrix, bias, stiffness**0.5, damping**0.5]
        parts = "matrix", "bias", "stiffness_root", "damping_root"
        dtype = fresh.matrix.dtype
        return eqx.tree_at(
            lambda each: [getattr(each, part) for part in parts],
            fresh,
            [jnp.asarray(leaf, dtype) for leaf in leaves],
        )

    def __call__(
        self,
        bodies: Bodies,
        theta: Float[Array, ""],
        dt: float,
    ) -> ActuatedMotion:
        """The motion that the control gives to free bodies in a step of ``dt`` [s].

        Nothing here is learned: steps with contacts would draw it away from what steps without tell
        exactly.
        """
        self = jax.lax.stop_gradient(self)
        position, velocity, nodes = bodies.position, bodies.velocity, bodies.nodes
        node_type = bodies.node_type * nodes.actuated[:, None]
        by_control = self.scale * jnp.einsum("nt,tdu->ndu", node_type, self.matrix)
        if nodes.control_of is not None:
            by_control = by_control * nodes.control_of[:, None, : self.control_size]
        turn = ((0, 0), (0, position.shape[1] - self.dimension))  # which nothing drives
        by_control = jnp.pad(by_control, (*turn, (0, 0)))
        if not self.servo:
            still = jnp.zeros_like(position[:, 0])
            return ActuatedMotion(still + 1.0, by_control, jnp.zeros_like(position), still, still)
        k, c = node_type @ self.stiffness_root**2, node_type @ self.damping_root**2
        inertia = 1.0 + theta * dt * (c + theta * dt * k)
        by_velocity = c + theta * dt * k
        constant = self.scale * node_type @ self.bias
        position, velocity = position[:, : self.dimension], velocity[:, : self.dimension]
        constant = constant - k[:, None] * position - by_velocity[:, None] * velocity
        constant = jnp.pad(constant, turn)
        return ActuatedMotion(
            inertia=inertia,
            by_control=by_control / inertia[:, None, None],
            constant=constant / inertia[:, None],
            stiffness=k / inertia,
            damping=by_velocity / inertia,
        )
