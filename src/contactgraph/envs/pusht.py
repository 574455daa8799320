"""The tasks ``pusht`` and ``pusht-pose``: the environment PushT of gym-pusht, by its map."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.envs.adapter import AdaptedTask, WatchedContact
from contactgraph.envs.contract import ChainCost
from contactgraph.envs.gripper_task import GOAL_WEIGHTS
from contactgraph.envs.push_and_pick import NEAR_WEIGHTS, PushPolicy, PushStyle, RandomPushes

TOLERANCE = 0.02
"""m, at any angle: see `PushTPoseTask` for the environment's own success."""
MAX_STEPS = 150
"""Half of the environment's own limit: a push to any goal takes a quarter."""
CONTROL_WEIGHT = 1e-4
"""1/m^2. The control is a place on the table, and none is better than another."""
ANGLE_WEIGHT = GOAL_WEIGHTS[0] * 0.055**2
"""1/rad^2: of a turn as of the way of points at the T's radius of gyration."""
_MAP = "pusht-state"
"""A pixel is a millimetre: PushT names no unit of length; so its table is half a metre wide."""
GOAL_ANGLE = np.pi / 4.0
STYLE = PushStyle(clearance=0.105, speed=0.2, lead=0.2, near_enough=0.015)
"""Of all scripted pushes. The simulator's servo follows a moving target 0.2 s behind it."""


def _make_environment() -> gymnasium.Env[Any, Any]:
    try:
        made = gymnasium.make("gym_pusht:gym_pusht/PushT-v0", disable_env_checker=True)
    except ImportError as error:
        raise InvalidInputError(
            f"PushT cannot start ({error.__cause__ or error}): pip install 'contactgraph[pusht]'"
        ) from error
    return _WatchedContact(made)


class _WatchedContact(WatchedContact):
    """Watches agent and block in ten substeps a step."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Starts an episode, in a new space; `touched` tells whether they touch."""
        found = super().reset(**options)
        inner: Any = self.unwrapped
        count, pair = inner.collision_handeler.post_solve, {inner.agent, inner.block}

        def watch(arbiter: Any, space: Any, data: Any) -> None:
            count(arbiter, space, data)
            self.touched |= {shape.body for shape in arbiter.shapes} == pair

        inner.collision_handeler.post_solve = watch
        self.touched = any(
            one.shapes_collide(other).points
            for one in inner.agent.shapes
            for other in inner.block.shapes
        )
        return found

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Makes a step, in which the simulator calls back for each contact of each substep."""
        self.touched = False
        return super().step(action)


class PushTTask(AdaptedTask):
    """An agent pushes a T to a goal (gym-pusht; success by position, at any angle).

    PushT, with pixels as millimetres. Nodes are the agent, a disc of radius 1.5 cm, and the block,
    a T whose node stands at its centre of mass. The control ``[2]`` m is the position to which a
    servo in the simulator takes the agent. Success is a final distance of at most 2 cm to the goal,
    at any angle. Raises `InvalidInputError` without gym-pusht.
    """

    name = "pusht"
    expert = partial(PushPolicy, STYLE, noise=0.01, variety=0.5)
    fixed_start = demonstrator = partial(PushPolicy, STYLE)
    explorer = partial(RandomPushes, STYLE, noise=0.02)
    horizon, starts = 30, 32
    success_terms: Mapping[str, Any] = {
        "cost": ChainCost((0, 1), NEAR_WEIGHTS, GOAL_WEIGHTS, CONTROL_WEIGHT),
        "max_steps": MAX_STEPS,
        "tolerance": TOLERANCE,
    }
    """The arguments of `AdaptedTask` that say what is to be reached."""

    def __init__(self) -> None:
        super().__init__(
            _make_environment,
            _MAP,
            name=self.name,
            contact=WatchedContact.contact,
            packages=("gym-pusht", "pymunk"),
            **self.success_terms,
        )


class PushTPoseTask(PushTTask):
    """As pusht, with its own success: the T covers 95 % of its outline at the goal.

    The angle counts, too. An episode has the environment's own 300 steps, and ends with success.
    Its score is the covered share.
    """

    name = "pusht-pose"
    success_terms = {  # noqa: RUF012 (never changed)
        "cost": replace(
            PushTTask.success_terms["cost"], goal_angle=GOAL_ANGLE, angle_weight=ANGLE_WEIGHT
        ),
        "max_steps": 2 * MAX_STEPS,
        "success_key": "is_success",
        "score_key": "coverage",
    }
