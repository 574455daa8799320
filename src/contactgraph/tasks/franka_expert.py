"""The scripted expert of the arm's pickup: a minimum-jerk sweep through the block to the goal."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.tasks.contract import Observation
from contactgraph.tasks.excitation import CorrelatedNoise
from contactgraph.tasks.franka_pickup import APPARENT_MASS, HAND, TARGET

STIFFNESS = np.array([600.0, 100.0, 600.0])
"""N/m"""
DAMPING = 4.0 * np.sqrt(STIFFNESS)
"""N s/m"""
SWEEP_SPEED = 0.38
"""In the plane, as the hand passes the block, m/s."""
RISE = 0.06
"""Upwards, as the hand passes the block, m/s: what is grasped leaves the table at once."""
_MEAN = 0.55
"""Mean speed of a way on the way to and from the sweep, in sweep speeds."""
LONGEST = 3.3
"""Of the whole way, s; longer ones are done faster."""


class FrankaExpert:
    """Sweeps through the block to the goal without stopping; the paper's gains.

    The way is a minimum-jerk path (quintic in time) to the block, which it passes at speed
    and rising, and another to the goal; the force is that of a spring and a damper to the path. The
    path is the hand's: the block is where it was grasped. The hand's mass is the scene's, or, where
    that is not told, the one that arms are made to feel like.

    ``noise`` N as in `PickupExpert`.
    """

    def __init__(self, noise: float = 0.2, correlation_steps: float = 10.0) -> None:
        self._noise = CorrelatedNoise(noise, correlation_steps)
        self._scene: Scene | None = None
        self._mass = APPARENT_MASS
        self._pieces: list[tuple[float, float, np.ndarray]] = []
        self._step = 0

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where ``scene`` is no such pickup."""
        if scene.goal is None or scene.dimension != 3 or scene.node_count <= TARGET:
            raise InvalidInputError(
                "the arm's expert needs a goal, three dimensions and a block as node 1, found "
                f"nodes {list(scene.node_name)} of dimension {scene.dimension}"
            )
        self._scene, self._pieces, self._step = scene, [], 0
        self._mass = APPARENT_MASS if scene.mass is None else float(scene.mass[HAND])
        self._noise.reset(3, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control [3] N."""
        assert self._scene is not None
        if not self._pieces:
            self._pieces = _plan(observation)
        position, velocity, acceleration = self._reference(self._step * self._scene.dt)
        self._step += 1
        force = STIFFNESS * (position - observation["position"][HAND])
        force += DAMPING * (velocity - observation["velocity"][HAND])
        return force + self._mass * acceleration + self._noise()

    def _reference(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        due = [piece for piece in self._pieces if piece[0] <= time]
        begin, duration, coefficients = due[-1]
        s = np.clip((time - begin) / duration, 0.0, 1.0)
        powers = s ** np.arange(6)
        first = np.arange(6) * s ** np.maximum(np.arange(6) - 1, 0)
        second = np.arange(6) * np.arange(-1, 5) * s ** np.maximum(np.arange(6) - 2, 0)
        return (
            powers @ coefficients,
            first @ coefficients / duration,
            second @ coefficients / duration**2,
        )


def _plan(observation: Observation) -> list[tuple[float, float, np.ndarray]]:
    """Begin s, duration s and coefficients [6, 3] of the pieces of the path."""
    start, block = observation["position"][[HAND, TARGET]]
    goal = observation["goal"]
    way = (block - start) * [1.0, 1.0, 0.0]
    sweep = SWEEP_SPEED * way / np.linalg.norm(way) + [0.0, 0.0, RISE]
    rest = np.zeros(3)
    first = float(np.linalg.norm(block - start)) / (_MEAN * SWEEP_SPEED)
    second = float(np.linalg.norm(goal - block)) / (_MEAN * SWEEP_SPEED)
    hurry = min(1.0, LONGEST / (first + second))
    first, second = hurry * first, hurry * second
    return [
        (0.0, first, _quintic(start, rest, block, sweep, first)),
        (first, second, _quintic(block, sweep, goal, rest, second)),
    ]


def _quintic(
    start: np.ndarray, speed: np.ndarray, end: np.ndarray, last: np.ndarray, duration: float
) -> np.ndarray:
    """[6, 3]: position over s in [0, 1], without acceleration at both ends (Flash, Hogan 1985)."""
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
