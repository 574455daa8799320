"""The task ``unknown-mass``: blocks that look alike and weigh differently are pushed to a goal."""

from dataclasses import replace
from functools import partial

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Conditions, Observation
from contactgraph.envs.exploration import NoisyPolicy
from contactgraph.envs.gripper_task import DT, GOAL_WEIGHTS, GRIPPER, MASS, MAX_FORCE
from contactgraph.envs.pickup import TARGET, CarryTask, Metadata
from contactgraph.envs.pickup_layout import HALF_WIDTH
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.push_and_pick import NEAR_WEIGHTS, PushPolicy, PushStyle, RandomPushes

MASSES = (0.5, 2.0)
"""Of the lightest and the heaviest block, kg."""
FRICTION = 0.3
"""Coulomb's coefficient between two bodies."""
GROUND_FRICTION = 0.1
"""Coulomb's coefficient between a block and the table: a deceleration of 0.98 m/s^2."""
CONTROL_WEIGHT = 3e-4
"""1/N^2: the way round a block, by forces of some newtons, must cost less than the last 2 cm."""


STYLE = PushStyle(clearance=0.13, speed=0.6, lead=1.0, near_enough=0.01, approach=2.0)
"""Of all scripted pushes. With a lead of 1 s, their displacement is the wanted velocity."""
TIME_CONSTANT = 0.06
"""Of the pusher's approach to a wanted velocity, s."""
MOST_RESISTANCE = 4.0
"""Force of a pushed block that is made up for, at most, N."""


class ForcedPush(NoisyPolicy):
    """Pushes by a force: a velocity controller under `PushPolicy`, or `RandomPushes`.

    It makes up for the resistance that the last step has shown, so that a heavy block is pushed at
    the wanted speed, too. ``variety`` is that of the pushes; ``random``: in random directions,
    within the area of the start, for exploration.
    """

    def __init__(self, noise: float = 0.5, variety: float = 0.3, random: bool = False) -> None:
        super().__init__(noise)
        inside = replace(STYLE, reach=HALF_WIDTH * np.array([[-1.0, -1.0], [1.0, 1.0]]))
        self._push = RandomPushes(inside) if random else PushPolicy(STYLE, variety=variety)

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where no force pushes a block."""
        if scene.control_kind != ("force", "force") or not scene.actuated[GRIPPER]:
            raise InvalidInputError(
                "a push by a force needs an actuated node 0 and a control of two forces, found "
                f"nodes {list(scene.node_name)} and {scene.control_kind}"
            )
        self._push.reset(replace(scene, control_kind=("displacement", "displacement")), seed)
        super().reset(scene, seed)
        self._given, self._velocity = np.zeros(2), np.zeros(2)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N."""
        velocity = observation["velocity"][GRIPPER]
        resistance = self._given - MASS * (velocity - self._velocity) / DT
        force = MASS * (self._push(observation) - velocity) / TIME_CONSTANT + self._noise()
        force += np.clip(resistance, -MOST_RESISTANCE, MOST_RESISTANCE)
        self._given, self._velocity = np.clip(force, -MAX_FORCE, MAX_FORCE), velocity
        return self._given


class UnknownMassTask(CarryTask):
    """A pusher moves a block of unknown mass to a goal.

    Nodes are the pusher (0), the target (1) and ``distractors`` further blocks. All are discs that
    do not rotate. The pusher has 1 kg, and the control ``[2]`` N is a force on it. A block has 0.5
    to 2 kg, drawn for each block of each episode, evenly in their logarithm; `Scene.mass` tells it,
    and nothing that is observed does. Blocks slide on a table with a coefficient of 0.1, so that
    all of them slow down alike; between two bodies it is 0.3, and impacts do not bounce. An episode
    runs for 200 steps, and succeeds if the target is within 2 cm of the goal at its end.

    Arguments: see `CarryTask`. Raises `InvalidInputError` where ``distractors`` is not in 0 to 20.
    """

    name = "unknown-mass"
    expert = ForcedPush
    fixed_start = demonstrator = partial(ForcedPush, noise=0.0, variety=0.0)
    explorer = partial(ForcedPush, random=True)
    horizon, starts = 30, 64
    conditions: Conditions = (("as trained", {}), ("3 distractors", {"distractors": 3}))
    goal_radius = 0.02
    types = ("pusher", "block")
    control_kind = ("force", "force")

    def hold_rule(self, seed: int) -> tuple[None, Metadata]:
        """Nothing is held."""
        return None, {
            "friction": FRICTION,
            "ground_friction": GROUND_FRICTION,
            "goal_radius": self.goal_radius,
        }

    def body(self, place: np.ndarray, node: int, seed: int) -> PlanarBody:
        """The pusher, or a block of drawn mass."""
        body = replace(super().body(place, node, seed), friction=FRICTION)
        if node == GRIPPER:
            return body
        # A stream of its own: the draws of the layout depend on the number of distractors.
        low, high = np.log(MASSES)
        drawn = np.random.default_rng([seed, 1]).uniform(low, high, node)
        return replace(body, mass=float(np.exp(drawn[-1])), ground_friction=GROUND_FRICTION)

    def cost_terms(self) -> ChainCost:
        """The target to the goal; hardly the pusher to the target."""
        return ChainCost((GRIPPER, TARGET), NEAR_WEIGHTS, GOAL_WEIGHTS, CONTROL_WEIGHT)
