"""A simulated hand and object without dynamics of an arm, for tests of controllers and limits."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from contactgraph_franka.safety.faults import Fault
from contactgraph_franka.safety.robot import RobotReading, Stop

CYCLE = 0.001
"""s, of control."""
_HAND_MASS = 4.0
"""kg, about the apparent mass of an arm's hand."""
_OBJECT_MASS = 0.4
"""kg."""
_GRASP = 0.015
"""m: the hand grasps the object at this distance, and keeps it."""
_NOISE = 1e-5
"""m, standard deviation of a measured position."""
_BRAKE = 200.0
"""N s/m, of the robot's own brake."""
_SILENCE = 3
"""Cycles without a command after which the robot brakes by itself."""
_HISTORY = 8
"""Readings kept: enough for the longest delay."""
_LONGEST_PAUSE = 0.02
"""s of simulation that `RealtimeFakeRobot` catches up with at most."""


class FakeRobot:
    """A `Robot`: a point mass moved by a force, and an object that it grasps on contact.

    No gravity, no friction; contact is inelastic (momentum is shared) and lasts. Time is simulated:
    each `advance` is one cycle of 1 ms, and `clock` gives the time. The same seed and forces give
    the same readings to the last bit, with noise of 0.01 mm on positions. Each of ``faults`` is
    present in its cycles, whatever the robot does.
    """

    def __init__(self, seed: int = 0, faults: Sequence[Fault] = ()) -> None:
        self._random = np.random.default_rng(seed)
        self._faults = tuple(faults)
        hand = self._random.uniform((0.4, -0.25, 0.15), (0.6, 0.0, 0.3))
        target = self._random.uniform((0.4, 0.1, 0.1), (0.6, 0.25, 0.25))
        self.position = np.stack([hand, target])
        """[2, 3] m: true positions of hand and object."""
        self.velocity = np.zeros((2, 3))
        """[2, 3] m/s."""
        self.applied = np.zeros(3)
        """[3] N: the last force received."""
        self.holding = False
        """Whether the hand holds the object."""
        self.stopped: Stop | None = None
        """The stop requested by `stop`, if any."""
        self.ended: Stop | None = None
        """A stop by the robot itself, set by tests. It brakes and ignores forces until `resume`."""
        self._cycle = 0
        self._command_cycle = 0
        self._past: deque[RobotReading] = deque(maxlen=_HISTORY)
        self._onset: dict[int, RobotReading] = {}
        self._measure()

    def clock(self) -> float:
        """s, since the robot was made."""
        return self._cycle * CYCLE

    @property
    def braking(self) -> bool:
        """Whether the robot's own brake acts: after a stop, or after 3 ms without a command."""
        stopped = self.stopped is not None or self.ended is not None
        return stopped or self._cycle - self._command_cycle > _SILENCE

    @property
    def late(self) -> bool:
        """Whether a fault withholds this cycle's plan; for the test's controller."""
        return any(fault.late for fault in self._active())

    def read(self) -> RobotReading | None:
        """The reading of this cycle, with the faults applied."""
        *past, newest = self._past
        reading: RobotReading | None = newest
        for index, fault in enumerate(self._faults):
            if fault.active(self._cycle) and reading is not None:
                onset = self._onset.setdefault(index, newest)
                reading = fault.corruption([*past, reading], onset)
        return reading

    def send(self, force: np.ndarray, now: float) -> np.ndarray | None:
        """The force, or None where a fault or a stop of the robot keeps it away."""
        if self._unreachable() or self.ended is not None:
            return None
        self._command_cycle = self._cycle
        self.applied = np.array(force, dtype=np.float64)
        return self.applied.copy()

    def stop(self, stop: Stop) -> None:
        """Brakes from now on, unless a fault keeps the call away."""
        if not self._unreachable() and self.stopped is None:
            self.stopped = stop

    def resume(self) -> None:
        """Ends `stop`, with no force."""
        if self.stopped is not None or self.ended is not None:
            self.stopped = self.ended = None
            self.applied = np.zeros(3)
            self._command_cycle = self._cycle

    def place(self, hand: np.ndarray, target: np.ndarray) -> None:
        """Puts hand and object at rest at ``hand`` and ``target`` [3] m, not grasped."""
        self.position = np.array([hand, target], dtype=np.float64)
        self.velocity = np.zeros((2, 3))
        self.holding = False

    def advance(self) -> None:
        """Simulates one cycle."""
        mass = _HAND_MASS + (_OBJECT_MASS if self.holding else 0.0)
        force = -_BRAKE * self.velocity[0] if self.braking else self.applied
        acceleration = force / mass
        displacement = (self.velocity[0] + acceleration * CYCLE / 2.0) * CYCLE
        self.velocity[0] += acceleration * CYCLE
        self.position[0] += displacement
        if self.holding:
            self.position[1] += displacement
            self.velocity[1] = self.velocity[0]
        elif np.linalg.norm(self.position[0] - self.position[1]) < _GRASP:
            self.holding = True
            self.velocity[:] = self.velocity[0] * (_HAND_MASS / (_HAND_MASS + _OBJECT_MASS))
        self._cycle += 1
        self._measure()

    def _measure(self) -> None:
        contact = np.zeros((2, 2))
        contact[0, 1] = contact[1, 0] = self.holding
        self._past.append(
            RobotReading(
                position=self.position + _NOISE * self._random.standard_normal((2, 3)),
                velocity=self.velocity.copy(),
                time=np.full(2, self.clock()),
                robot_time=self.clock(),
                tracked=np.ones(2, dtype=bool),
                variance=np.full((2, 3), _NOISE**2),
                contact=contact,
            )
        )

    def _active(self) -> list[Fault]:
        return [fault for fault in self._faults if fault.active(self._cycle)]

    def _unreachable(self) -> bool:
        return any(fault.drops_commands for fault in self._active())


class RealtimeFakeRobot:
    """A `Robot`: a `FakeRobot` that advances with ``clock`` (s), whether it is read or not.

    Readings are stamped on ``clock``, and at most a cycle old.
    """

    def __init__(self, robot: FakeRobot, clock: Callable[[], float]) -> None:
        self.robot = robot
        self._clock = clock
        self._began = clock() - robot.clock()
        self._read_at = -1.0

    @property
    def ended(self) -> Stop | None:
        """See `FakeRobot`."""
        return self.robot.ended

    def read(self) -> RobotReading | None:
        """The newest reading; None where no cycle has passed."""
        self._catch_up()
        if self.robot.clock() <= self._read_at:
            return None
        self._read_at = self.robot.clock()
        reading = self.robot.read()
        return None if reading is None else replace(reading, time=reading.time + self._began)

    def send(self, force: np.ndarray, now: float) -> np.ndarray | None:
        """Applies ``force`` from the next cycle on."""
        return self.robot.send(force, now)

    def stop(self, stop: Stop) -> None:
        """Brakes from now on."""
        self.robot.stop(stop)

    def resume(self) -> None:
        """Ends `stop`."""
        self._catch_up()
        self.robot.resume()

    def _catch_up(self) -> None:
        now = self._clock()
        # A longer pause is skipped, since simulating it would delay the caller.
        self._began = max(self._began, now - self.robot.clock() - _LONGEST_PAUSE)
        while self.robot.clock() + CYCLE <= now - self._began:
            self.robot.advance()
