"""Starts by several routes to where the cost is least: straight, and round either side."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from contactgraph.control.box_qp import AffinePolicy, solve_small
from contactgraph.control.cost import QuadraticCost
from contactgraph.control.ilqr import PlanningProblem
from contactgraph.control.multi_start import Starts
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import pair_indices
from contactgraph.model import ContactBelief, ContactDynamics, ModelState, Nodes

_WIDEST = 2.0
"""rad; angle by which the outer routes turn aside."""
_ASIDE = 0.25
"""Part of the horizon for which they do."""
_GAIN = 0.5
"""Part of the distance that is left which a step covers, at most."""
_RIDGE = 1e-6
"""Of the mean square response to the control; controls that move nothing stay 0."""
_TINY = 1e-9


class FreeMotion(eqx.Module):
    """Velocities of the nodes after a step in which they touch nothing, ``v' = A x + B u + offset``
    in each coordinate, and the control that gives a wanted one in least squares."""

    A: Float[Array, "N G 2"]
    offset: Float[Array, "N G"]
    inverse: Float[Array, "N U D"]
    """The control for each m/s of the node."""

    @classmethod
    def of(
        cls, model: ContactDynamics, state: ModelState, nodes: Nodes, speed: float
    ) -> "FreeMotion":
        """At a state; ``speed`` [m/s] is about what driven nodes reach: dry friction holds a body
        at rest, and hardly matters to one that is driven."""
        alone = nodes._replace(candidate=jnp.zeros_like(nodes.candidate), planes=None)
        driven = jnp.where(nodes.actuated[:, None], speed * model.dt, 0.0)
        driven = jnp.broadcast_to(driven, state.velocity.shape).astype(state.velocity.dtype)
        still = jnp.zeros(model.control_size, state.velocity.dtype)
        graph = model.encode_state(state, still, alone)
        free = model.linearize(dataclasses.replace(graph, control_displacement=driven))
        B = free.B[:, : model.dimension, 1, :]
        square = jnp.einsum("ndu,ndv->uvn", B, B)
        size = len(square)
        ridge = _RIDGE * jnp.trace(square) / size + jnp.finfo(B.dtype).tiny
        inverse = solve_small(square + ridge * jnp.eye(size)[..., None], B.transpose(2, 1, 0))
        return cls(free.A[..., 1, :], free.offset[..., 1], inverse.transpose(2, 0, 1))


class Routes(eqx.Module):
    """Routes to where the cost is least: one by each of as many angles, from 2 rad to one side to
    2 rad to the other.

    iLQR alone stays on the side of a body on which its guess passes, or stops before it. A route
    leads each driven body to where the cost of positions is least for it and all that it holds,
    moved as one, at the model's unit of speeds. It turns aside at first.
    """

    count: int = eqx.field(static=True, default=7)

    def __check_init__(self) -> None:
        if self.count < 1:
            raise InvalidInputError(f"routes must be 1 or more, found {self.count}")

    def __call__(self, problem: PlanningProblem) -> Starts:
        """A start for each route, with gains that follow its velocities as if the driven bodies
        touched nothing.

        Raises `InvalidInputError` where the model is no `ContactDynamics`.
        """
        model, state, nodes = problem.model, problem.state, problem.nodes
        if not isinstance(model, ContactDynamics):
            raise InvalidInputError(f"routes need a ContactDynamics, found {type(model).__name__}")
        dimension, horizon = model.dimension, problem.planner.horizon
        speed = getattr(model.features, "speed", 1.0)
        motion = FreeMotion.of(model, state, nodes, speed)
        inverse = jnp.where((nodes.actuated & nodes.mask)[:, None, None], motion.inverse, 0.0)
        aim = _place_of_least_cost(state, problem.cost)[:, :dimension]
        wanted = (
            self._velocities(aim, horizon, model.dt, speed) - motion.offset[:, :dimension, None]
        )
        K = -jnp.einsum("nud,ndx->unxd", inverse, motion.A[:, :dimension])
        K = jnp.pad(K, [(0, 0)] * 3 + [(0, state.position.shape[1] - dimension)])
        K = jnp.broadcast_to(K[None, ..., None], (horizon, *K.shape, self.count))
        return Starts(AffinePolicy(K, jnp.einsum("nud,tnds->tus", inverse, wanted)))

    def _velocities(
        self, aim: Float[Array, "N D"], horizon: int, dt: float, speed: float
    ) -> Float[Array, "H N D S"]:
        """m/s; of bodies that are led to ``aim`` [m], from where they are."""
        angle = np.linspace(-_WIDEST, _WIDEST, self.count) if self.count > 1 else np.zeros(1)
        cosine, sine = np.cos(angle), np.sin(angle)

        def step(at: Array, turns: Array) -> tuple[Array, Array]:
            away = aim[..., None] - at
            x, y = away[:, 0], away[:, 1]
            turned = away.at[:, 0].set(cosine * x - sine * y).at[:, 1].set(sine * x + cosine * y)
            way = jnp.where(turns, turned, away)
            length = jnp.sqrt(jnp.sum(way**2, axis=1, keepdims=True) + _TINY**2)
            velocity = way * jnp.minimum(speed / length, _GAIN / dt)
            return at + dt * velocity, velocity

        turns = jnp.arange(horizon) < _ASIDE * horizon
        begin = jnp.zeros((*aim.shape, self.count), aim.dtype)
        return jax.lax.scan(step, begin, turns)[1]


def _place_of_least_cost(state: ModelState, cost: QuadraticCost) -> Float[Array, "N G"]:
    """m, from each body; where the last step's cost of positions is least, if the body moves there
    with all that it is believed to be joined to."""
    count, size = state.position.shape
    Q, goal = cost.last
    curvature = Q.reshape(count, 2, size, count, 2, size)[:, 0, :, :, 0]
    away = state.position - goal.reshape(count, 2, size)[:, 0]
    slope = jnp.einsum("ndme,me->nd", curvature, away)
    group = _joined(state.belief, count).astype(slope.dtype)
    slope = jnp.einsum("nm,md->dn", group, slope)
    curvature = jnp.einsum("nm,nk,mdke->den", group, group, curvature)
    ridge = _RIDGE * jnp.trace(curvature) + _TINY
    curvature += ridge * jnp.eye(size)[..., None]
    return -solve_small(curvature, slope[:, None])[:, 0].T


def _joined(belief: ContactBelief, count: int) -> Bool[Array, "N N"]:
    """Whether two bodies are one, or joined by a chain of edges that are believed to be active."""
    first, second = pair_indices(count).T
    active = belief.over(None, len(first)).probability > 0.5
    joined = jnp.eye(count, dtype=bool).at[first, second].set(active).at[second, first].set(active)
    for _ in range((count - 1).bit_length()):
        joined = jnp.any(joined[:, :, None] & joined, axis=1)
    return joined
