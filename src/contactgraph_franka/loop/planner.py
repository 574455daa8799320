"""What plans for a robot, and what it answers with. ``N`` nodes in ``D`` dimensions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from contactgraph_franka.robot.contract import RobotReading


@dataclass(frozen=True, eq=False)
class Start:
    """What a planner is told before a run."""

    reading: RobotReading
    goal: np.ndarray
    """[D] m"""
    seed: int = 0
    """Of whatever is random about the planner."""


@dataclass(frozen=True, eq=False)
class Moment:
    """What a planner is told about one moment of a run."""

    time: float
    """s, on the loop's clock: a plan's law counts its seconds from here."""
    reading: RobotReading
    applied: np.ndarray
    """[D] N, the mean of what was really sent since the moment before: limits may have changed what
    was asked for, and feedback did."""


class Law(Protocol):
    """What to do while no newer plan is there: cheap, since it is asked a thousand times a second.

    A law that comes late still acts right, because it is asked by the time that has passed since
    the moment it was made from, not since it came. It owns its numbers, and can be pickled; whoever
    runs the loop must have imported what it is made of: see `laws`.
    """

    @property
    def duration(self) -> float:
        """s, for which it has an answer."""

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """[D] N, ``elapsed`` s in [0, duration] after its moment, at [N, D] m and m/s."""


class Planner(Protocol):
    """Something that takes its time."""

    @property
    def interval(self) -> float:
        """s between the moments that it is told."""

    def begin(self, start: Start) -> None:
        """Prepares for a run, and forgets the last one. May take long: nothing moves yet.

        Raises `InvalidInputError` where it cannot plan for what was read.
        """

    def plan(self, moments: Sequence[Moment]) -> Law | None:
        """The law from the last of ``moments`` on; None where no plan was found.

        ``moments`` are all since the last call, at least one: more than one where planning took
        longer than ``interval``.
        """
