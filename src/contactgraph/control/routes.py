"""iLQR from several routes at once to where the cost is least: straight, and round either side."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from contactgraph.control.box_qp import AffinePolicy, solve_small
from contactgraph.control.candidates import best_plan, side_by_side
from contactgraph.control.cost import Cost, QuadraticCost
from contactgraph.control.ilqr import ILQR, Progress
from contactgraph.control.lanes import in_lanes
from contactgraph.control.plan import Plan
from contactgraph.control.rollout import SweptBounds
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import pair_indices
from contactgraph.model import ContactBelief, ContactDynamics, ModelState, Nodes, StepModel

_WIDEST = 2.0
"""rad; angle by which the outer routes turn aside."""
_ASIDE = 0.25
"""Part of the horizon for which they do."""
_GAIN = 0.5
"""Part of the distance that is left which a step covers, at most."""
_RIDGE = 1e-6
"""Of the mean square response to the control; controls that move nothing stay 0."""
_TRIED = 2
"""Rollouts of each route, after which the best one is known well enough."""
_LANES = 8
"""Of a vector; of more candidates the best after their first rollouts go on."""
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


class RouteILQR(ILQR):
    """`ILQR` from the guess and from ``routes`` others, side by side; the plan of the lowest cost.

    iLQR alone stays on the side of a body on which its guess passes, or stops before it. A route
    leads each driven body to where the cost of positions is least for it and all that it holds,
    moved as one. It turns aside at first: one route by each of as many angles, from 2 rad to one
    side to 2 rad to the other. The guess is always among the candidates, so the plan's cost is
    never above the guess's.
    """

    routes: int = eqx.field(static=True, default=7)
    speed: float = eqx.field(static=True, default=1.0)
    """m/s, along a route."""

    def __check_init__(self) -> None:
        if self.routes < 1 or not self.speed > 0.0:
            raise InvalidInputError(
                f"routes must be 1 or more and speed positive, found {self.routes} and {self.speed}"
            )

    def solve(
        self,
        model: StepModel,
        state: ModelState,
        nodes: Nodes,
        cost: Cost,
        guess: AffinePolicy | None = None,
    ) -> Plan:
        """The plan of the lowest cost; see `ILQR.solve`. ``iterations`` counts all rollouts.

        Raises `InvalidInputError` where the model is no `ContactDynamics`.
        """
        if not isinstance(model, ContactDynamics):
            raise InvalidInputError(f"routes need a ContactDynamics, found {type(model).__name__}")
        quadratic, guess = self.prepared(model, state, cost, guess)
        guesses = side_by_side(guess, self._begun(model, state, nodes, quadratic))

        def searched(begin: AffinePolicy | Progress, rollouts: int, lanes: int) -> Progress:
            return in_lanes(
                lambda each: self.search(model, state, nodes, quadratic, each, rollouts), lanes
            )(begin)

        count = self.routes + 1
        tried = min(_TRIED, self.iterations)
        rounds = [searched(guesses, tried if count <= _LANES else 1, count)]
        if count > _LANES:
            rounds.append(searched(_best(rounds[0], _LANES), tried, _LANES))
        rounds.append(searched(_best(rounds[-1], 2), self.iterations, 2))
        plans = in_lanes(lambda each: self.plan_of(each, quadratic), 2)(rounds[-1])
        return _with_dropped(
            best_plan(jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), plans)), rounds
        )

    def _begun(
        self, model: ContactDynamics, state: ModelState, nodes: Nodes, cost: QuadraticCost
    ) -> AffinePolicy:
        """A policy for each route: K [H, U, N, 2, G, S] and k [H, U, S].

        It follows the route's velocities as if the driven bodies touched nothing.
        """
        dimension = model.dimension
        motion = FreeMotion.of(model, state, nodes, self.speed)
        inverse = jnp.where((nodes.actuated & nodes.mask)[:, None, None], motion.inverse, 0.0)
        aim = _place_of_least_cost(state, cost)[:, :dimension]
        wanted = self._velocities(aim, model.dt) - motion.offset[:, :dimension, None]
        K = -jnp.einsum("nud,ndx->unxd", inverse, motion.A[:, :dimension])
        K = jnp.pad(K, [(0, 0)] * 3 + [(0, state.position.shape[1] - dimension)])
        K = jnp.broadcast_to(K[None, ..., None], (self.horizon, *K.shape, self.routes))
        return AffinePolicy(K, jnp.einsum("nud,tnds->tus", inverse, wanted))

    def _velocities(self, aim: Float[Array, "N D"], dt: float) -> Float[Array, "H N D S"]:
        """m/s; of bodies that are led to ``aim`` [m], from where they are."""
        angle = np.linspace(-_WIDEST, _WIDEST, self.routes) if self.routes > 1 else np.zeros(1)
        cosine, sine = np.cos(angle), np.sin(angle)

        def step(at: Array, turns: Array) -> tuple[Array, Array]:
            away = aim[..., None] - at
            x, y = away[:, 0], away[:, 1]
            turned = away.at[:, 0].set(cosine * x - sine * y).at[:, 1].set(sine * x + cosine * y)
            way = jnp.where(turns, turned, away)
            length = jnp.sqrt(jnp.sum(way**2, axis=1, keepdims=True) + _TINY**2)
            velocity = way * jnp.minimum(self.speed / length, _GAIN / dt)
            return at + dt * velocity, velocity

        turns = jnp.arange(self.horizon) < _ASIDE * self.horizon
        begin = jnp.zeros((*aim.shape, self.routes), aim.dtype)
        return jax.lax.scan(step, begin, turns)[1]


def _best(progress: Progress, count: int) -> Progress:
    """The first lane and those of the others with the lowest costs, ``count`` in all."""
    cost = progress[0].cost[1:]
    others = jnp.argsort(jnp.where(jnp.isfinite(cost), cost, jnp.inf))[: count - 1]
    lanes = jnp.concatenate([jnp.zeros(1, others.dtype), 1 + others])
    return jax.tree.map(lambda leaf: leaf[..., lanes], progress)


def _with_dropped(plan: Plan, rounds: list[Progress]) -> Plan:
    """The plan with the rollouts and bounds of lanes that were dropped after each round, too."""
    count = plan.iterations
    swept = plan.swept
    for before, after in itertools.pairwise(rounds):
        went_on = _best(before, after[0].cost.size)[0].iteration
        count += jnp.sum(before[0].iteration) - jnp.sum(went_on)
        if swept is not None and before[1] is not None:
            swept = SweptBounds(
                jnp.minimum(swept.lower, jnp.min(before[1].lower, axis=-1)),
                jnp.maximum(swept.upper, jnp.max(before[1].upper, axis=-1)),
            )
    return dataclasses.replace(plan, iterations=count, swept=swept)


def _place_of_least_cost(state: ModelState, cost: QuadraticCost) -> Float[Array, "N G"]:
    """m, from each body; where the last step's cost of positions is least, if the body moves there
    with all that it is believed to be joined to."""
    count, size = state.position.shape
    Q, _, goal = cost.over(1)
    curvature = Q[-1].reshape(count, 2, size, count, 2, size)[:, 0, :, :, 0]
    away = state.position - goal[-1].reshape(count, 2, size)[:, 0]
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
