"""Rules that tie bodies of a `PlanarWorld` together: at touch, by a switch, for or after a time.

A rule is of one world, and of one episode.
"""

import math
from collections.abc import Collection

import numpy as np

from contactgraph.envs.gripper_task import GRIPPER
from contactgraph.envs.planar.world import PlanarWorld

SWITCH_ON = 0.5
"""A switch above this is on."""
DELAY = 0.4
"""Touching time before a delayed hold, s."""
HOLD_TIME = (0.5, 2.0)
"""Shortest and longest duration of a hold that ends by itself, s."""
HOLD_TENSION = 4.0
"""Force that ends a hold by pulling the pair apart, N."""
HIDDEN_ON = (0.4, 1.4)
"""Shortest and longest time for which a hidden switch stays on, s."""
HIDDEN_OFF = (0.3, 1.2)
"""The same of a hidden switch that is off, s."""
PARTING_TIME = 0.05
"""Time without a touch after which a pair has parted, s."""

_ROUNDING = 1e-9
"""Rounding errors of a sum of substeps, s."""


def touched(world: PlanarWorld) -> set[int]:
    """The nodes that the gripper touches or holds now, not only earlier in the step."""
    pairs = world.touching_pairs | world.joined_pairs
    return {other for first, other in pairs if first == GRIPPER}


def held_by_gripper(world: PlanarWorld) -> set[int]:
    """The nodes that the gripper holds now."""
    return {other for first, other in world.joined_pairs if first == GRIPPER}


class HoldAtTouch:
    """Ties together all bodies that touch, for good."""

    def update(self, world: PlanarWorld, dt: float) -> None:
        """Joins the pairs that touch now."""
        for first, second in sorted(world.touching_pairs):
            world.join(first, second)


class SwitchedHold:
    """The gripper holds what it touches while the world's switch is above 0.5."""

    def update(self, world: PlanarWorld, dt: float) -> None:
        """Joins all that the gripper touches, or parts all that it holds."""
        held = held_by_gripper(world)
        if world.switch > SWITCH_ON:
            for node in sorted(touched(world) - held):
                world.join(GRIPPER, node)
        else:
            for node in sorted(held):
                world.part(GRIPPER, node)


class HiddenSwitchHold(SwitchedHold):
    """As `SwitchedHold`, but a random process operates the switch, and nothing records it.

    The switch starts on or off with equal probability; ``on`` and ``off`` are the shortest and the
    longest time, s, for which it stays so. All is drawn from ``seed``.
    """

    def __init__(
        self,
        seed: int,
        on: tuple[float, float] = HIDDEN_ON,
        off: tuple[float, float] = HIDDEN_OFF,
    ) -> None:
        self._times = {True: on, False: off}
        self._rng = np.random.default_rng(seed)
        self._on = bool(self._rng.random() < 0.5)
        self._left = float(self._rng.uniform(*self._times[self._on]))

    def update(self, world: PlanarWorld, dt: float) -> None:
        """Joins or parts the gripper's pairs after a substep of ``dt`` s."""
        self._left -= dt
        if self._left <= _ROUNDING:
            self._on = not self._on
            self._left = float(self._rng.uniform(*self._times[self._on]))
        world.switch = float(self._on)
        super().update(world, dt)


class BreakingHold:
    """The gripper holds at touch; a hold ends when it is pulled too hard, or after a random time.

    ``tension`` N is the limit of the force that pulls the pair apart. The duration of each hold is
    uniform in ``times`` s, drawn from ``seed``; None: no hold ends by itself. A pair whose hold has
    ended can be held again only once it has parted: after 0.05 s without a touch. ``nodes`` are the
    bodies that can be held; None: all.
    """

    def __init__(
        self,
        seed: int = 0,
        times: tuple[float, float] | None = None,
        tension: float = HOLD_TENSION,
        nodes: Collection[int] | None = None,
    ) -> None:
        self._times, self._tension = times, tension
        self._rng = np.random.default_rng(seed)
        self.nodes = None if nodes is None else frozenset(nodes)
        """The bodies that can be held; None: all."""
        self.left: dict[int, float] = {}
        """The time after which each hold ends by itself, s."""
        self._apart: dict[int, float] = {}

    def update(self, world: PlanarWorld, dt: float) -> None:
        """Joins or parts the gripper's pairs after a substep of ``dt`` s."""
        touching = touched(world)
        self._part(world, dt)
        self._wait_for_parting(touching, dt)
        can_hold = touching if self.nodes is None else touching & self.nodes
        for node in sorted(can_hold - set(self.left) - set(self._apart)):
            world.join(GRIPPER, node)
            self.left[node] = math.inf if self._times is None else self._rng.uniform(*self._times)

    def _part(self, world: PlanarWorld, dt: float) -> None:
        for node in sorted(self.left):
            self.left[node] -= dt
            if self.left[node] <= _ROUNDING or world.joint_tension(GRIPPER, node) > self._tension:
                world.part(GRIPPER, node)
                del self.left[node]
                self._apart[node] = 0.0

    def _wait_for_parting(self, touching: set[int], dt: float) -> None:
        """Counts the time for which pairs whose hold has ended have not touched."""
        self._apart = {
            node: 0.0 if node in touching else apart + dt for node, apart in self._apart.items()
        }
        self._apart = {
            node: apart for node, apart in self._apart.items() if apart < PARTING_TIME - _ROUNDING
        }


class DelayedHold:
    """The gripper holds a body after ``delay`` s of touching it without interruption."""

    def __init__(self, delay: float = DELAY) -> None:
        self._delay = delay
        self._since: dict[int, float] = {}

    def update(self, world: PlanarWorld, dt: float) -> None:
        """Joins the gripper's pairs that have touched for long enough, after ``dt`` s."""
        touching = touched(world) - held_by_gripper(world)
        # The substep of the touch itself does not count: it began somewhere within it.
        self._since = {
            node: self._since[node] + dt if node in self._since else 0.0 for node in touching
        }
        for node in sorted(touching):
            if self._since[node] >= self._delay - _ROUNDING:
                world.join(GRIPPER, node)
                del self._since[node]
