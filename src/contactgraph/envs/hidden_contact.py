"""Tasks in which geometry does not tell the contact: suction, release, delay and others."""

from dataclasses import replace
from typing import Any, cast

import gymnasium
import numpy as np

from contactgraph.data import Scene
from contactgraph.envs.carry_expert import (
    CarryExpert,
    LookAlikesExpert,
    StickyExpert,
    SuctionExpert,
)
from contactgraph.envs.contract import ChainCost, Conditions, Observation, PolicyFactory
from contactgraph.envs.grip import (
    HOLD_TIME,
    SWITCH_ON,
    BreakingHold,
    DelayedHold,
    HiddenSwitchHold,
    SwitchedHold,
)
from contactgraph.envs.gripper_task import GRIPPER, MAX_FORCE, check_count
from contactgraph.envs.handling import HandlingPolicy
from contactgraph.envs.pickup import MAX_OBJECTS, TARGET, CarryTask, Metadata
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.planar.world import HoldRule, PlanarWorld

HOLD_SHARE = 0.25
"""Probability that a body of `StickyTask` holds."""
_SWITCH_WEIGHT = 1e-4
"""Cost of a step with the switch on, as much as of a target 1.4 mm from the goal: a target that
rests there, at less than 2 mm/s, is let go."""
_SWITCHING_COST = 0.015
"""Of switching on, as much as of a target 4 mm from the goal for 20 steps: one that drifts off
slowly is not taken again at once."""
_PLACED_RADIUS = 0.008
"""Distance from the goal within which the target lies there, m; 0.02 are allowed."""
_WELD_TENSION = 7.5
"""Force that ends a hold of look-alikes, N: above half the largest control, so that it is no limit
for a single free body."""
WELDED_MASS = 100.0
"""kg, of a welded body as far as a scene tells: no pull moves it noticeably."""
REST_SPEED = 0.02
"""The target must be slower than this, m/s."""


class HiddenHoldTask(CarryTask):
    """A task in which geometry does not tell what is held; what is held is observed."""

    observes_holding = True
    expert: PolicyFactory = CarryExpert
    explorer: PolicyFactory = HandlingPolicy
    exploration = 0.5
    starts = 32
    conditions: Conditions = (("as trained", {}), ("3 distractors", {"distractors": 3}))


class SuctionTask(HiddenHoldTask):
    """A suction gripper takes an object to a goal and puts it down.

    The gripper holds what it touches while its switch is on. The control ``[3]`` is a force on the
    gripper, N, and the switch, 0 to 1, on above 0.5. The target is to be put down: in the end it
    lies within 2 cm of the goal and is slower than 2 cm/s, the gripper does not hold it, and the
    switch is off.

    With ``hidden_switch`` the control ``[2]`` is the force alone: a random process that nothing
    records operates the switch, and the target must end within 0.1 m of the goal.

    Raises `InvalidInputError` where ``distractors`` is not in 0 to 20.
    """

    name = "suction"
    expert = SuctionExpert
    max_force = None
    starts = 0
    """A plan of switches takes none."""
    steps = 240
    goal_radius = 0.02

    def __init__(
        self,
        distractors: int = 0,
        fixed_seed: int | None = None,
        hidden_switch: bool = False,
        engine: str | None = None,
    ) -> None:
        super().__init__(distractors, fixed_seed, engine=engine)
        self._hidden_switch = hidden_switch
        if hidden_switch:
            self.goal_radius, self.starts = CarryTask.goal_radius, HiddenHoldTask.starts
        else:
            high = np.array([MAX_FORCE, MAX_FORCE, 1.0])
            self.action_space = gymnasium.spaces.Box(np.append(-high[:2], 0.0), high, dtype=float)

    def hold_rule(self, seed: int) -> tuple[HoldRule, Metadata]:
        """The rule of the switch, and whether it is hidden."""
        rule = HiddenSwitchHold(seed) if self._hidden_switch else SwitchedHold()
        return rule, {"hidden_switch": self._hidden_switch}

    def begin(self, seed: int) -> tuple[Scene, PlanarWorld]:
        """Samples the scene of a seed, with everything at rest."""
        scene, world = super().begin(seed)
        if self._hidden_switch:
            return scene, world
        control_of = np.repeat(scene.actuated[:, None], 3, axis=1)
        kind = ("force", "force", "switch")
        return replace(scene, control_kind=kind, control_of=control_of), world

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advances by ``scene.dt`` under force and switch, each clipped to its bounds."""
        if not self._hidden_switch:
            cast(PlanarWorld, self.world).switch = float(self.bounded(action)[-1])
        return super().step(action)

    def cost_terms(self) -> ChainCost:
        """The weights of pickup; with a switch also those that make putting down pay."""
        terms = super().cost_terms()
        if self._hidden_switch:
            return terms
        return replace(
            terms,
            command_weight=_SWITCH_WEIGHT,
            switching_cost=_SWITCHING_COST,
            placed_radius=_PLACED_RADIUS,
        )

    def success(self) -> bool:
        """Whether the episode is over and has ended as the task demands."""
        if not super().success() or self._hidden_switch:
            return super().success()
        world = cast(PlanarWorld, self.world)
        released = not world.holding[GRIPPER, TARGET] and world.switch <= SWITCH_ON
        return bool(released and np.linalg.norm(world.velocity[TARGET]) <= REST_SPEED)


class ReleaseTask(HiddenHoldTask):
    """A gripper that loses its hold after a hidden time takes an object to a goal.

    It holds at touch, for 0.5 to 2 s; a joint force above 4 N ends a hold, too. The pair can be
    held again only after it has parted. The control ``[2]`` N is a force on the gripper. The target
    must end within 0.1 m of the goal. Raises `InvalidInputError` where ``distractors`` is not in 0
    to 20.
    """

    name = "release"

    def hold_rule(self, seed: int) -> tuple[HoldRule, Metadata]:
        """Holds of random durations."""
        return BreakingHold(seed, HOLD_TIME), {}


class DelayTask(HiddenHoldTask):
    """A gripper that holds after 0.4 s of touching takes an object to a goal.

    The touch must not be interrupted; a hold lasts to the end. The control ``[2]`` N is a force on
    the gripper. The target must end within 0.1 m of the goal. Raises `InvalidInputError` where
    ``distractors`` is not in 0 to 20.
    """

    name = "delay"

    def hold_rule(self, seed: int) -> tuple[HoldRule, Metadata]:
        """Holds after a time."""
        return DelayedHold(), {}


class StickyTask(HiddenHoldTask):
    """A gripper finds an object that holds among look-alikes, and takes it to a goal.

    Of ``objects`` targets and of the distractors, each holds with probability 1/4, drawn for each
    episode, but at least one target does and one does not. A body that holds does so from touch to
    the end. The control ``[2]`` N is a force on the gripper. A body that holds must end within
    0.1 m of the goal.

    Raises `InvalidInputError` where ``objects`` is not in 2 to 5 or ``distractors`` in 0 to 20.
    """

    name = "sticky"
    expert: PolicyFactory = StickyExpert
    steps = 300

    def __init__(
        self,
        objects: int = 3,
        distractors: int = 0,
        fixed_seed: int | None = None,
        engine: str | None = None,
    ) -> None:
        check_count("objects", objects, 2, MAX_OBJECTS)
        self.targets = objects
        super().__init__(distractors, fixed_seed, engine=engine)
        self._carriable = frozenset({TARGET})
        """Bodies of which any may end at the goal."""

    def hold_rule(self, seed: int) -> tuple[HoldRule, Metadata]:
        """Holds of drawn bodies; their nodes, as text, are metadata."""
        rng = np.random.default_rng(seed)
        drawn = np.zeros(self.targets, dtype=bool)
        while drawn.all() or not drawn.any():
            drawn = rng.random(self.targets) < HOLD_SHARE
        drawn = np.concatenate([drawn, rng.random(self.distractors) < HOLD_SHARE])
        self._carriable = frozenset((1 + np.flatnonzero(drawn)).tolist())
        holders = " ".join(map(str, sorted(self._carriable)))
        return BreakingHold(nodes=self._carriable), {"holders": holders}

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether a body that can be carried is within 0.1 m of the goal."""
        away = np.linalg.norm(position[list(self._carriable)] - scene.goal, axis=-1)
        return bool(away.min() <= self.goal_radius)

    def cost_terms(self) -> ChainCost:
        """The weights of pickup, along any of the targets: the right one must be found out."""
        return replace(super().cost_terms(), candidates=tuple(range(1, 1 + self.targets)))


class LookAlikesTask(StickyTask):
    """Of two look-alikes, one is welded to the table; a gripper holds the other at a goal.

    Which one is drawn for each episode, and nothing observed tells it but that it does not move.
    The gripper holds what it touches until more than 7.5 N pull the pair apart, which its control
    can do only where a body is welded; it can hold it again once it has parted. The control ``[2]``
    N is a force on the gripper. The other body must end within 0.1 m of the goal, in contact with
    the gripper. Raises `InvalidInputError` where ``distractors``, which are not welded, is not in 0
    to 20.
    """

    name = "look-alikes"
    expert = LookAlikesExpert
    steps = 200
    any_order = True

    def __init__(
        self, distractors: int = 0, fixed_seed: int | None = None, engine: str | None = None
    ) -> None:
        super().__init__(2, distractors, fixed_seed, engine)

    def hold_rule(self, seed: int) -> tuple[HoldRule, Metadata]:
        """Holds of all bodies, that a pull ends; the free one of the two is metadata."""
        free = int(np.random.default_rng(seed).integers(1, 3))
        self._carriable = frozenset({free})
        return BreakingHold(tension=_WELD_TENSION), {"free": free}

    def body(self, place: np.ndarray, node: int, seed: int) -> PlanarBody:
        """That of a node, static where it is welded."""
        body = super().body(place, node, seed)
        welded = node in {1, 2} - self._carriable
        return replace(body, static=True, mass=WELDED_MASS) if welded else body

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether the free body is within 0.1 m of the goal, and in contact with the gripper."""
        touched = contact[GRIPPER, list(self._carriable)].all()
        return bool(touched) and super().solved(scene, position, contact)
