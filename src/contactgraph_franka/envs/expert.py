"""Paths of a hand that are quintic in time (Flash, Hogan 1985), and the force that follows them."""

from collections.abc import Sequence

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.experts import CorrelatedNoise
from contactgraph_franka.envs.pickup import APPARENT_MASS, HAND, TARGET

STIFFNESS = np.array([600.0, 100.0, 600.0])
"""N/m, the paper's."""
DAMPING = 4.0 * np.sqrt(STIFFNESS)
"""N s/m"""


class HandPath:
    """Motions one after the other, each with the least jerk for its ends."""

    def __init__(self) -> None:
        self._pieces: list[tuple[float, float, np.ndarray]] = []
        self.duration = 0.0
        """s, of all of it."""

    def go(
        self,
        start: np.ndarray,
        speed: np.ndarray,
        end: np.ndarray,
        last: np.ndarray,
        duration: float,
    ) -> None:
        """From ``start`` [3] m at ``speed`` [3] m/s to ``end`` at ``last`` in ``duration`` s."""
        self._pieces.append((self.duration, duration, _quintic(start, speed, end, last, duration)))
        self.duration += duration

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position m, velocity m/s and acceleration m/s^2, each [3], ``time`` s after its start.

        After its end it rests, if it came to rest.
        """
        begin, duration, coefficients = [p for p in self._pieces if p[0] <= time][-1]
        s = np.clip((time - begin) / duration, 0.0, 1.0)
        powers = s ** np.arange(6)
        first = np.arange(6) * s ** np.maximum(np.arange(6) - 1, 0)
        second = np.arange(6) * np.arange(-1, 5) * s ** np.maximum(np.arange(6) - 2, 0)
        return (
            powers @ coefficients,
            first @ coefficients / duration,
            second @ coefficients / duration**2,
        )

    def force(
        self, time: float, position: np.ndarray, velocity: np.ndarray, mass: float
    ) -> np.ndarray:
        """[3] N: spring and damper to the path, and what accelerates ``mass`` kg along it."""
        wanted, speed, acceleration = self.at(time)
        return STIFFNESS * (wanted - position) + DAMPING * (speed - velocity) + mass * acceleration


def _quintic(
    start: np.ndarray, speed: np.ndarray, end: np.ndarray, last: np.ndarray, duration: float
) -> np.ndarray:
    """[6, 3]: position over s in [0, 1], without acceleration at both ends."""
    way = end - start - duration * speed
    change = duration * (last - speed)
    zero = np.zeros(3)
    return np.stack(
        [
            start,
            duration * speed,
            zero,
            10.0 * way - 4.0 * change,
            -15.0 * way + 7.0 * change,
            6.0 * way - 3.0 * change,
        ]
    )


SWEEP_SPEED = 0.38
"""In the plane, as the hand passes the block, m/s."""
RISE = 0.06
"""Upwards, as the hand passes the block, m/s: what is grasped leaves the table at once."""
_MEAN = 0.55
"""Mean speed of a way on the way to and from the sweep, in sweep speeds."""
_SHORTEST = 0.5
"""Of a way from rest to rest, s."""
LONGEST = 3.3
"""Of the whole way, s; longer ones are done faster."""
_GRASP_S = 0.6
"""s for fingers to close, where the hand stops for it."""


class FrankaExpert:
    """Sweeps through the block to the goal without stopping; the paper's gains.

    The way is a minimum-jerk path (quintic in time) to the block, which it passes at speed
    and rising, and another to the goal; the force is that of a spring and a damper to the path. The
    path is the hand's: the block is where it was grasped. The hand's mass is the scene's, or, where
    that is not told, the one that arms are made to feel like. With a ``stop`` [3] m it rests so
    far from the block's centre until the fingers have closed, instead of passing.

    ``noise`` N as in `PickupExpert`. With ``further`` [K, 3] m it goes on from the goal to these
    points, one after the other, resting at each.
    """

    def __init__(
        self,
        noise: float = 0.2,
        correlation_steps: float = 10.0,
        further: Sequence[np.ndarray] = (),
        stop: np.ndarray | None = None,
    ) -> None:
        self._stop = stop
        self._noise = CorrelatedNoise(noise, correlation_steps)
        self._further = tuple(further)
        self._scene: Scene | None = None
        self._mass = APPARENT_MASS
        self._path: HandPath | None = None
        self._step = 0

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where ``scene`` is no such pickup."""
        if scene.goal is None or scene.dimension != 3 or scene.node_count <= TARGET:
            raise InvalidInputError(
                "the arm's expert needs a goal, three dimensions and a block as node 1, found "
                f"nodes {list(scene.node_name)} of dimension {scene.dimension}"
            )
        self._scene, self._path, self._step = scene, None, 0
        self._mass = APPARENT_MASS if scene.mass is None else float(scene.mass[HAND])
        self._noise.reset(3, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control [3] N."""
        assert self._scene is not None
        if self._path is None:
            stop = self._stop
            self._path = _plan(observation) if stop is None else _stopping(observation, stop)
            for start, end in zip(
                (observation["goal"], *self._further), self._further, strict=False
            ):
                visit(self._path, start, end)
        time = self._step * self._scene.dt
        self._step += 1
        hand, velocity = observation["position"][HAND], observation["velocity"][HAND]
        return self._path.force(time, hand, velocity, self._mass) + self._noise()


def visit(path: HandPath, start: np.ndarray, end: np.ndarray) -> None:
    """Goes on from ``start`` [3] m, where it rests, to rest at ``end`` [3] m."""
    rest = np.zeros(3)
    duration = float(np.linalg.norm(end - start)) / (_MEAN * SWEEP_SPEED)
    path.go(start, rest, end, rest, max(duration, _SHORTEST))


def _plan(observation: Observation) -> HandPath:
    """Through the block to the goal."""
    start, block = observation["position"][[HAND, TARGET]]
    goal = observation["goal"]
    way = (block - start) * [1.0, 1.0, 0.0]
    sweep = SWEEP_SPEED * way / np.linalg.norm(way) + [0.0, 0.0, RISE]
    rest = np.zeros(3)
    first = float(np.linalg.norm(block - start)) / (_MEAN * SWEEP_SPEED)
    second = float(np.linalg.norm(goal - block)) / (_MEAN * SWEEP_SPEED)
    hurry = min(1.0, LONGEST / (first + second))
    path = HandPath()
    path.go(start, rest, block, sweep, hurry * first)
    path.go(block, sweep, goal, rest, hurry * second)
    return path


def _stopping(observation: Observation, stop: np.ndarray) -> HandPath:
    """To ``stop`` [3] m from the block's centre, and from there to the goal."""
    hand, block = observation["position"][[HAND, TARGET]]
    path, rest, there = HandPath(), np.zeros(3), block + stop
    visit(path, hand, there)
    path.go(there, rest, there, rest, _GRASP_S)
    visit(path, there, observation["goal"])
    return path
