"""A start by the best of many approaches: going to a body to push or grasp it, or staying.

iLQR alone follows the contacts that a rollout happens to make: where a body must be pushed from its
far side, its A and B do not see the body at all. So the model rolls out approaches of the bodies
that the cost is about, by the actuated bodies that may touch them, and iLQR polishes the best.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.control.box_qp import AffinePolicy, ControlLimits
from contactgraph.control.cost import QuadraticCost
from contactgraph.control.ilqr import ILQR, PlanningProblem
from contactgraph.control.lanes import in_lanes
from contactgraph.control.multi_start import Starts
from contactgraph.control.proposals.approach import (
    Approach,
    Draws,
    against_gravity,
    length,
    level,
    level_reach,
    unit,
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


_STAND_OFF = 1.5
"""Contact distances from the body where a push begins at the nearest."""
_FASTEST = 1.5
"""Greatest speed of pushes, in units of the top speed."""
_BANKED = 0.1
"""Spread about the line to an image of the goal."""
_ELITES = 8
"""Approaches that the next round varies."""
_LEVEL, _ELASTIC = 0.1, 0.3
"""Of a wall off which a body may be played: how far its normal points up at most, and how much the
body bounces off it at least."""


class Approaches(eqx.Module):
    """The best of many approaches.

    Each of two rounds rolls out ``starts`` approaches as one batch: the first from all sides, the
    others near the best eight. Where bodies bounce off walls, every second one aims at an image of
    the goal in one of them. To stay is among them. The draws follow from the positions: equal
    states give equal plans, and from step to step others are tried.

    The model must be a `ContactDynamics` with `InvariantFeatures`, whose contact distance says how
    to go round a body, and whose unit of speeds how fast.
    """

    starts: int = eqx.field(static=True, default=32)

    def __check_init__(self) -> None:
        if self.starts < _ELITES:
            raise InvalidInputError(f"starts must be {_ELITES} or more, found {self.starts}")

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
        keys = jax.random.split(jax.random.fold_in(jax.random.key(0), jnp.sum(bits)), 2)
        draws = [Draws.of(key, self.starts, scene.model.dimension, commands) for key in keys]
        bounds = planner.limits or ControlLimits(-jnp.ones(commands), jnp.ones(commands))
        most = [each[len(each) - commands :] for each in (bounds.lower, bounds.upper)]
        follow = eqx.filter_jit(in_lanes(lambda each: scene.follow(each, planner), self.starts))

        def tried(approaches: Approach) -> tuple[Array, Array]:
            behind = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), approaches)
            controls, costs = follow(behind)
            controls = jnp.moveaxis(controls, -1, 0)
            return controls, costs + planner.switching(problem.guess, controls)

        approaches = scene.spread(draws[0], most)
        controls, costs = tried(approaches)
        near = approaches.at(jnp.argsort(costs)[:_ELITES]).varied(draws[1], scene.up)
        more, costs_near = tried(near)
        controls, costs = jnp.concatenate([controls, more]), jnp.concatenate([costs, costs_near])
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

    @property
    def up(self) -> Float[Array, " D"]:
        """Unit vector against gravity, along which none pushes; zeros without."""
        return against_gravity(self.nodes, self.model.dimension)

    def spread(self, draws: Draws, commands: Sequence[Float[Array, " C"]]) -> Approach:
        """Approaches of all sides, every second one near the line to the goal; the first one stays.

        Speeds are spread evenly by their logarithm, from a twelfth of the top speed to 1.5 times
        it; on the way from a third to all of it. Half of them swerve. With ``commands``, the least
        and greatest value of each, and gravity all others are grasps, from above: pushing with
        fingers is seldom seen in what a model learned from. Without commands, but with edges that
        hold, every fourth one is a grasp by touch.
        """
        count, speed, up = len(draws.speed), self.speed, self.up
        hand, body, goal, aim, turn = self.pairs(count)
        position = self.state.position[:, : self.model.dimension]
        missing = aim - position[body]
        # How far it is to turn takes pushes from any side.
        distance = jnp.sqrt(length(missing) ** 2 + turn**2)
        number = jnp.arange(count)
        has_commands = draws.command.shape[1] > 0
        touch_holds = any(each.holds for each in self.model.inference.edge_types)
        grasps = (number > 0) & jnp.any(up != 0.0) & has_commands
        by_touch = (number % 4 == 2) & (touch_holds and not has_commands)
        high = jnp.where(draws.command > 0.0, commands[1], commands[0])
        banked = jnp.any(aim != goal, axis=-1)[:, None]
        wide = jnp.where(number % 2 == 0, 1.0, 0.25)[:, None]
        wide = jnp.where(banked, _BANKED, wide)
        direction = missing / distance[:, None] + wide * draws.direction
        straight = unit(position[body] - position[hand]) + wide * draws.direction
        direction = jnp.where(by_touch[:, None], straight, direction)
        travel = distance * jnp.exp(0.3 * draws.travel)
        beside = jnp.where(banked, _BANKED, 0.3) * draws.aside
        share = jax.scipy.stats.norm.cdf  # of slower ones, evenly spread
        return Approach(
            hand=hand,
            body=body,
            direction=jnp.where(grasps[:, None], -up, unit(level(direction, up))),
            aside=jnp.where((grasps | by_touch)[:, None], 0.0, beside),
            speed=_FASTEST * speed * jnp.exp(-2.9 * share(draws.speed)),
            travel=travel.at[0].set(0.0),
            run_up=_STAND_OFF * jnp.exp(share(draws.run_up)),
            swerve=jnp.where((number % 4 < 2)[:, None], 0.0, draws.swerve),
            approach_speed=speed * jnp.exp(-share(draws.approach_speed)),
            goal=goal,
            grasps=grasps | by_touch,
            by_touch=by_touch,
            command=jnp.stack([commands[0] + commands[1] - high, high], axis=1),
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
        weight = jnp.diagonal(self.cost.last[0]).reshape(number, 2, -1)[body, 0]
        turn = jnp.where(weight > 0.0, jnp.abs(goal - position), 0.0)[:, self.model.dimension :]
        turn = jnp.sum(turn, axis=-1)
        goal = goal[:, : self.model.dimension]
        head = getattr(self.model.local_dynamics, "head", None)
        if nodes.planes is None or not len(nodes.planes) or not isinstance(head, ContactLaw):
            return hand, body, goal, goal, turn
        bounce, _ = head.laws(self.model.features.node_type(nodes, position.dtype), body)
        start = np.arange(count)
        wall = nodes.planes[start // 2 % len(nodes.planes)]
        normal, before = wall[:, :-1], jnp.sum(wall[:, :-1] * goal, axis=-1) - wall[:, -1]
        banked = (start % 2 == 1) & (jnp.abs(normal @ self.up) < _LEVEL) & (bounce > _ELASTIC)
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
