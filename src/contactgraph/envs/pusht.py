"""The task ``pusht``: the environment PushT of gym-pusht, by its map."""

from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.envs.adapter import AdaptedTask, WatchedContact, watched_contact
from contactgraph.envs.contract import ChainCost
from contactgraph.envs.environment_map import Entries, EnvironmentMap, MappedBody, MappedControl
from contactgraph.envs.pickup import GOAL_WEIGHTS
from contactgraph.envs.push_and_pick import NEAR_WEIGHTS, PushPolicy, PushStyle, RandomPushes

SCALE = 0.001
"""m per pixel: PushT names no unit of length; so its table is half a metre wide."""
TOLERANCE = 0.02
"""m, at any angle: see `pusht_pose_task` for the environment's own success."""
MAX_STEPS = 150
"""Half of the environment's own limit: a push to any goal takes a quarter."""
CONTROL_WEIGHT = 1e-4
"""1/m^2. The control is a place on the table, and none is better than another."""
ANGLE_WEIGHT = GOAL_WEIGHTS[0] * 0.055**2
"""1/rad^2: of a turn as of the way of points at the T's radius of gyration."""
AGENT_RADIUS = 0.015
CENTRE = np.array([0.0, 0.045])
"""m, in the block's frame: its centre of mass in the simulator."""
BARS = (
    np.array([[-0.06, 0.0], [0.06, 0.0], [0.06, 0.03], [-0.06, 0.03]]),
    np.array([[-0.015, 0.03], [0.015, 0.03], [0.015, 0.12], [-0.015, 0.12]]),
)
"""m, in the block's frame: the two bars of the T."""
WALLS = (0.007, 0.504)
"""m: inner faces of the four walls, on both axes. They stop the block, not the agent."""
GOAL, GOAL_ANGLE = np.array([0.256, 0.256]), np.pi / 4.0


def pusht_pose_task() -> AdaptedTask:
    """PushT with its own success: the T covers 95 % of its outline at the goal, at the angle too.

    An episode has the environment's own 300 steps, and ends with success. Its score is the covered
    share.
    """
    return AdaptedTask(
        _make_environment,
        replace(
            _pusht_map(),
            name="pusht-pose",
            cost=ChainCost(
                (0, 1),
                NEAR_WEIGHTS,
                GOAL_WEIGHTS,
                CONTROL_WEIGHT,
                goal_angle=GOAL_ANGLE,
                angle_weight=ANGLE_WEIGHT,
            ),
            max_steps=2 * MAX_STEPS,
            tolerance=None,
            success_key="is_success",
            score_key="coverage",
        ),
    )


def pusht_task() -> AdaptedTask:
    """PushT, with pixels as millimetres; raises `InvalidInputError` without gym-pusht.

    Nodes are the agent, a disc of radius 1.5 cm, and the block, a T whose node stands at its centre
    of mass. The control ``[2]`` m is the position to which a servo in the simulator takes the
    agent. Success is a final distance of at most 2 cm to the goal, at any angle.
    """
    return AdaptedTask(_make_environment, _pusht_map())


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


def _pusht_map() -> EnvironmentMap:
    sine, cosine = np.sin(GOAL_ANGLE), np.cos(GOAL_ANGLE)
    goal = GOAL + np.array([[cosine, -sine], [sine, cosine]]) @ CENTRE
    reach = np.array([[-0.001, -0.001], [0.513, 0.513]])
    low, high = WALLS
    return EnvironmentMap(
        name="pusht",
        dt=0.1,
        bodies=(
            MappedBody(
                name="agent",
                type="agent",
                position=Entries(0, 2),
                orientation=(0.0,),
                actuated=True,
                bounds=reach,
            ),
            MappedBody(
                name="block",
                type="block",
                position=Entries(2, 4),
                orientation=Entries(4, 5),
                reference=tuple(CENTRE),
                bounds=reach,
                polygons=tuple(bar - CENTRE for bar in BARS),
            ),
        ),
        control=MappedControl(
            kind=("position", "position"),
            body=("agent", "agent"),
            entries=(0, 1),
            scale=(SCALE, SCALE),
        ),
        goal=(float(goal[0]), float(goal[1])),
        cost=ChainCost((0, 1), NEAR_WEIGHTS, GOAL_WEIGHTS, CONTROL_WEIGHT),
        max_steps=MAX_STEPS,
        tolerance=TOLERANCE,
        scale=SCALE,
        contact=watched_contact,
        planes=np.array([[1.0, 0.0, low], [-1.0, 0.0, -high], [0.0, 1.0, low], [0.0, -1.0, -high]]),
    )


STYLE = PushStyle(clearance=0.105, speed=0.2, lead=0.2, near_enough=0.015)
"""Of all scripted pushes. The simulator's servo follows a moving target 0.2 s behind it."""
pusht_fixed_start = partial(PushPolicy, STYLE)
pusht_expert = partial(PushPolicy, STYLE, noise=0.01, variety=0.5)
pusht_explorer = partial(RandomPushes, STYLE, noise=0.02)
