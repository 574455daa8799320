"""A hand and an object, for tests of everything that talks to a robot."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from contactgraph_franka.loop.realtime import Clock
from contactgraph_franka.safety.faults import Fault
from contactgraph_franka.safety.robot import RobotReading, Stop

TICK = 0.001
"""s."""
_HAND_MASS = 4.0
"""kg, as heavy as an arm's hand feels."""
_OBJECT_MASS = 0.4
"""kg."""
_GRASP = 0.015
"""m: where the hand comes as near as this, it holds the object from then on."""
_NOISE = 1e-5
"""m, standard deviation of a read position."""
_BRAKE = 200.0
"""N s/m, of the robot's own brake."""
_SILENCE = 3
"""Ticks without a command after which the robot brakes by itself."""
_MEMORY = 8
"""Readings that are kept: enough for the longest delay."""


class FakeRobot:
    """A `Robot`: a point mass that a force moves, and an object that it picks up by touching it.

    No gravity, no friction; a touch is inelastic (momentum is shared) and lasts. Time is simulated:
    each `advance` is one tick of 1 ms, `clock` tells it. The same seed and the same forces give the
    same readings to the last bit, with noise of 0.01 mm on positions. ``faults`` are there in their
    ticks, whatever the robot does.
    """

    def __init__(self, seed: int = 0, faults: Sequence[Fault] = ()) -> None:
        self._random = np.random.default_rng(seed)
        self._faults = tuple(faults)
        hand = self._random.uniform((0.4, -0.25, 0.15), (0.6, 0.0, 0.3))
        thing = self._random.uniform((0.4, 0.1, 0.1), (0.6, 0.25, 0.25))
        self.position = np.stack([hand, thing])
        """[2, 3] m: hand and object, as they truly are."""
        self.velocity = np.zeros((2, 3))
        """[2, 3] m/s."""
        self.applied = np.zeros(3)
        """[3] N: what was last heard."""
        self.holding = False
        """Whether the hand holds the object."""
        self.stopped: Stop | None = None
        """Why the robot was told to stop, if it was."""
        self.ended: Stop | None = None
        """Why it stopped by itself, for tests to set. It brakes and is deaf until `resume`."""
        self._tick = 0
        self._heard_tick = 0
        self._past: deque[RobotReading] = deque(maxlen=_MEMORY)
        self._onset: dict[int, RobotReading] = {}
        self._remember()

    def clock(self) -> float:
        """s, since the robot was made."""
        return self._tick * TICK

    @property
    def braking(self) -> bool:
        """Whether it brakes by its own means: told to, or since it has heard nothing for 3 ms."""
        told = self.stopped is not None or self.ended is not None
        return told or self._tick - self._heard_tick > _SILENCE

    @property
    def late(self) -> bool:
        """Whether a fault says that no plan comes in this tick: for the test's controller."""
        return any(fault.late for fault in self._active())

    def read(self) -> RobotReading | None:
        """This tick's reading, as the faults leave it."""
        *past, newest = self._past
        reading: RobotReading | None = newest
        for index, fault in enumerate(self._faults):
            if fault.active(self._tick) and reading is not None:
                onset = self._onset.setdefault(index, newest)
                reading = fault.corruption([*past, reading], onset)
        return reading

    def send(self, force: np.ndarray, now: float) -> np.ndarray | None:
        """The force, or None where a fault keeps it away."""
        if self._deaf() or self.ended is not None:
            return None
        self._heard_tick = self._tick
        self.applied = np.array(force, dtype=np.float64)
        return self.applied.copy()

    def stop(self, stop: Stop) -> None:
        """Brakes from now on, unless a fault keeps it away."""
        if not self._deaf() and self.stopped is None:
            self.stopped = stop

    def resume(self) -> None:
        """Ends `stop`, with no force."""
        if self.stopped is not None or self.ended is not None:
            self.stopped = self.ended = None
            self.applied = np.zeros(3)
            self._heard_tick = self._tick

    def place(self, hand: np.ndarray, thing: np.ndarray) -> None:
        """Puts hand and object at rest at ``hand`` and ``thing`` [3] m, apart from each other."""
        self.position = np.array([hand, thing], dtype=np.float64)
        self.velocity = np.zeros((2, 3))
        self.holding = False

    def advance(self) -> None:
        """Moves on by one tick."""
        mass = _HAND_MASS + (_OBJECT_MASS if self.holding else 0.0)
        force = -_BRAKE * self.velocity[0] if self.braking else self.applied
        acceleration = force / mass
        moved = (self.velocity[0] + acceleration * TICK / 2.0) * TICK
        self.velocity[0] += acceleration * TICK
        self.position[0] += moved
        if self.holding:
            self.position[1] += moved
            self.velocity[1] = self.velocity[0]
        elif np.linalg.norm(self.position[0] - self.position[1]) < _GRASP:
            self.holding = True
            self.velocity[:] = self.velocity[0] * (_HAND_MASS / (_HAND_MASS + _OBJECT_MASS))
        self._tick += 1
        self._remember()

    def _remember(self) -> None:
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
        return [fault for fault in self._faults if fault.active(self._tick)]

    def _deaf(self) -> bool:
        return any(fault.deaf for fault in self._active())


_LONGEST_UNSEEN = 0.02
"""s"""


class RealtimeFakeRobot:
    """A `Robot`: a `FakeRobot` that goes on while nobody looks, as arms do.

    Readings are stamped on ``clock``, and at most a tick old.
    """

    def __init__(self, robot: FakeRobot, clock: Clock) -> None:
        self.robot = robot
        self._clock = clock
        self._began = clock() - robot.clock()
        self._read_at = -1.0

    @property
    def ended(self) -> Stop | None:
        """Why the fake robot stopped by itself, if it did."""
        return self.robot.ended

    def read(self) -> RobotReading | None:
        """What the ticks that have passed have led to; None where none has."""
        self._catch_up()
        if self.robot.clock() <= self._read_at:
            return None
        self._read_at = self.robot.clock()
        reading = self.robot.read()
        if reading is None:
            return None
        return RobotReading(
            position=reading.position,
            velocity=reading.velocity,
            time=reading.time + self._began,
            robot_time=reading.robot_time,
            tracked=reading.tracked,
            variance=reading.variance,
            contact=reading.contact,
        )

    def send(self, force: np.ndarray, now: float) -> np.ndarray | None:
        """From the next tick on."""
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
        # While nobody looks for long, nothing happens: a second to make up for takes its time.
        self._began = max(self._began, now - self.robot.clock() - _LONGEST_UNSEEN)
        while self.robot.clock() + TICK <= now - self._began:
            self.robot.advance()
