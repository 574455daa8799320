"""A start by the best of many approaches: going to a body to push or grasp it, or staying.

iLQR alone follows the contacts that a rollout happens to make: where a body must be pushed from its
far side, its A and B do not see the body at all. So the model rolls out approaches of the bodies
that the cost is about, by the actuated bodies that may touch them, and iLQR polishes the best.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.control.box_qp import AffinePolicy, ControlLimits
from contactgraph.control.cost import QuadraticCost
from contactgraph.control.ilqr import ILQR
from contactgraph.control.lanes import in_lanes
from contactgraph.control.multi_start import PlanningProblem, Starts
from contactgraph.control.proposals.approach import (
    Approach,
    Draws,
    against_gravity,
    level_reach,
    spread_approaches,
    varied_approaches,
)
from contactgraph.control.proposals.routes import FreeMotion
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import edge_id, pair_indices
from contactgraph.model import (
    ContactDynamics,
    ContactLaw,
    InvariantFeatures,
    ModelState,
    Nodes,
    StepModel,
    take_step,
)


def searches(model: StepModel) -> bool:
    """Whether `Approaches` are found with this model."""
    return isinstance(model, ContactDynamics) and isinstance(model.features, InvariantFeatures)


_ELITES = 8
"""Approaches that the next round varies."""
_LEVEL, _ELASTIC = 0.1, 0.3
"""Of a wall off which a body may be played: how far its normal points up at most, and how much the
body bounces off it at least."""


class Approaches(eqx.Module):
    """The best of many approaches.

    Each of ``rounds`` rolls out ``starts`` approaches as one batch: the first from all sides, the
    others near the best eight. Where bodies bounce off walls, every second one aims at an image of
    the goal in one of them. To stay is among them. The draws follow from the positions: equal
    states give equal plans, and from step to step others are tried.

    The model must be a `ContactDynamics` with `InvariantFeatures`, whose contact distance says how
    to go round a body, and whose unit of speeds how fast.
    """

    starts: int = eqx.field(static=True, default=64)
    rounds: int = eqx.field(static=True, default=2)

    def __check_init__(self) -> None:
        if self.starts < _ELITES or self.rounds < 1:
            raise InvalidInputError(
                f"starts must be {_ELITES} or more and rounds 1 or more, found {self.starts} and "
                f"{self.rounds}"
            )

    def __call__(self, problem: PlanningProblem) -> Starts:
        """One start. Raises `InvalidInputError` where the model is another."""
        model = problem.model
        if not searches(model):
            raise InvalidInputError(
                "a search for starts needs a ContactDynamics with InvariantFeatures, found "
                f"{type(model).__name__}"
            )
        assert isinstance(model, ContactDynamics)
        found = self._best(problem, _Scene.of(problem), model.inference.commands)
        best = AffinePolicy(jnp.zeros_like(problem.guess.K), found)
        # iLQR makes grasps faster than fingers hold; with commands the approach is the plan.
        improved = not model.inference.commands
        return Starts(jax.tree.map(lambda leaf: leaf[..., None], best), improved=improved)

    def _best(
        self, problem: PlanningProblem, scene: "_Scene", commands: int
    ) -> Float[Array, "H U"]:
        """The controls of the cheapest approach."""
        planner, position = problem.planner, scene.state.position
        bits = jax.lax.bitcast_convert_type(position.astype(jnp.float32), jnp.uint32)
        keys = jax.random.split(jax.random.fold_in(jax.random.key(0), jnp.sum(bits)), self.rounds)
        draws = [Draws.of(key, self.starts, scene.model.dimension, commands) for key in keys]
        bounds = planner.limits or ControlLimits(-jnp.ones(commands), jnp.ones(commands))
        most = [each[len(each) - commands :] for each in (bounds.lower, bounds.upper)]
        follow = eqx.filter_jit(in_lanes(lambda each: scene.follow(each, planner), self.starts))

        def tried(approaches: Approach) -> tuple[Array, Array]:
            behind = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), approaches)
            controls, costs = follow(behind)
            controls = jnp.moveaxis(controls, -1, 0)
            return controls, costs + planner.switching(problem.guess, controls)

        up = against_gravity(scene.nodes, scene.model.dimension)
        holds = any(each.holds for each in scene.model.inference.edge_types)
        approaches = spread_approaches(
            *(draws[0], *scene.pairs(self.starts)),
            position=position[:, : scene.model.dimension],
            top_speed=scene.speed,
            up=up,
            commands=(most[0], most[1]),
            touch_holds=holds and not commands,
        )
        controls, costs = tried(approaches)
        for again in draws[1:]:
            best = jnp.argsort(costs)[:_ELITES]
            near = varied_approaches(again, approaches.at(best), up)
            all_tried = (approaches, controls, costs), (near, *tried(near))
            approaches, controls, costs = jax.tree.map(
                lambda one, other: jnp.concatenate([one, other]), *all_tried
            )
        return controls[jnp.argmin(costs)]


class _Scene(eqx.Module):
    """What the rollouts from a state have in common; a node's control is that of free motion, also
    while it touches another."""

    model: ContactDynamics
    speed: float
    """m/s; the top speed of the data."""
    state: ModelState
    nodes: Nodes
    cost: QuadraticCost
    free: FreeMotion
    reach: Float[Array, " N"]
    """m; see `level_reach`."""

    @classmethod
    def of(cls, problem: PlanningProblem) -> "_Scene":
        model, state, nodes = problem.model, problem.state, problem.nodes
        assert isinstance(model, ContactDynamics) and isinstance(model.features, InvariantFeatures)
        speed = model.features.speed
        return cls(
            model=model,
            speed=speed,
            state=state,
            nodes=nodes,
            cost=problem.cost,
            free=FreeMotion.of(model, state, nodes, speed),
            reach=level_reach(nodes, state.position, model.features.turn_length),
        )

    def pairs(self, count: int) -> tuple[Array, Array, Array, Array, Array]:
        """Actuated nodes [S], each with one that it may move, in turn; that one's goal and aim
        [S, D], m: every second one's is an image of the goal in one wall after another, if
        the body bounces off walls; and how far it is to turn, m."""
        nodes, number = self.nodes, len(self.state.position)
        wanted = nodes.passive
        if self.cost.cost_node_ids is not None:
            wanted = wanted & jnp.zeros(number, bool).at[self.cost.cost_node_ids].set(True)
        first, second = pair_indices(number).T
        one, other = np.concatenate([[first, second], [second, first]], axis=1)
        candidate = jnp.concatenate([nodes.candidate, nodes.candidate])
        may_move = candidate & nodes.actuated[one] & nodes.mask[one] & wanted[other]
        pair = jnp.argsort(~may_move)[jnp.arange(count) % jnp.maximum(jnp.sum(may_move), 1)]
        hand, body = jnp.asarray(one)[pair], jnp.asarray(other)[pair]
        position = self.state.position[body]
        goal = self.cost.goal.reshape(-1, number, 2, position.shape[1])[-1, body, 0]
        weight = jnp.diagonal(self.cost.over(1)[0][-1]).reshape(number, 2, -1)[body, 0]
        turn = jnp.where(weight > 0.0, jnp.abs(goal - position), 0.0)[:, self.model.dimension :]
        turn = jnp.sum(turn, axis=-1)
        goal = goal[:, : self.model.dimension]
        head = getattr(self.model.local_dynamics, "head", None)
        if nodes.planes is None or not len(nodes.planes) or not isinstance(head, ContactLaw):
            return hand, body, goal, goal, turn
        bounce, _ = head.laws(self.model.features.node_type(nodes, position.dtype), body)
        start = np.arange(count)
        wall = nodes.planes[start // 2 % len(nodes.planes)]
        up = against_gravity(nodes, self.model.dimension)
        normal, before = wall[:, :-1], jnp.sum(wall[:, :-1] * goal, axis=-1) - wall[:, -1]
        banked = (start % 2 == 1) & (jnp.abs(normal @ up) < _LEVEL) & (bounce > _ELASTIC)
        image = goal - 2.0 * before[:, None] * normal
        return hand, body, goal, jnp.where(banked[:, None], image, goal), turn

    def follow(
        self, approach: Approach, planner: ILQR
    ) -> tuple[Float[Array, "H U"], Float[Array, ""]]:
        """The controls of one approach, rolled out; and their cost, infinite where not finite."""
        hand, begin = approach.hand, self.state.position
        edge = jnp.stack([hand, approach.body])[:, None]
        held = edge_id(jnp.min(edge), jnp.max(edge))
        features = self.model.features
        assert isinstance(features, InvariantFeatures)
        distance = features.distances(self.nodes, edge, begin.dtype)
        distance = jnp.broadcast_to(jnp.asarray(distance), (1,))[0]
        distance += jnp.sum(jax.nn.relu(self.reach[edge] - 0.5 * features.length))
        free = jax.tree.map(lambda leaf: leaf[hand], self.free)

        def step(state: ModelState, _: None) -> tuple[ModelState, tuple]:
            holding = state.belief.over(None, len(self.nodes.candidate)).holding[held] > 0.5
            wanted, command = approach.wanted(
                state.position, state.velocity, holding, begin, distance, self.model.dt
            )
            x = jnp.stack([state.position[hand], state.velocity[hand]], axis=-1)
            drift = free.offset + jnp.sum(free.A * x, axis=-1)
            control = free.inverse @ (wanted - drift[: len(wanted)])
            control = control.at[len(control) - len(command) :].set(command)
            control = control if planner.limits is None else planner.limits(control)
            after = take_step(self.model, state, control, self.nodes)[0]
            moved = jnp.stack([after.position, after.velocity], axis=1)
            return after, (moved, control, after.belief)

        _, (moved, controls, beliefs) = jax.lax.scan(step, self.state, None, length=planner.horizon)
        start = jnp.stack([begin, self.state.velocity], axis=1)
        total = self.cost(jnp.concatenate([start[None], moved]), controls, beliefs)
        return controls, jnp.where(jnp.isfinite(total), total, jnp.inf)
