"""A tour of the arm's hand that grasps nothing: what a free hand does under a force."""

from collections.abc import Sequence

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.experts import CorrelatedNoise
from contactgraph.envs.pickup_layout import distance_to_way
from contactgraph_franka.envs.expert import FrankaExpert, HandPath, visit
from contactgraph_franka.envs.pickup import (
    APPARENT_MASS,
    EDGE,
    HAND,
    HIGH,
    LOW,
    NEAR,
    REACH,
    START_HEIGHT,
    TARGET,
)


class FreeSpaceExcitation:
    """From where the hand is to each of ``points`` [K, 3] m, resting there; noise as the expert's.

    Raises `InvalidInputError` where there are no points.
    """

    def __init__(
        self, points: Sequence[np.ndarray], noise: float = 0.2, correlation_steps: float = 10.0
    ) -> None:
        if not len(points):
            raise InvalidInputError("a tour needs at least one point, found none")
        self._points = tuple(points)
        self._noise = CorrelatedNoise(noise, correlation_steps)
        self._path: HandPath | None = None
        self._dt, self._step = 0.0, 0

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._dt, self._path, self._step = scene.dt, None, 0
        self._noise.reset(3, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control [3] N."""
        hand, velocity = observation["position"][HAND], observation["velocity"][HAND]
        if self._path is None:
            self._path = HandPath()
            for start, end in zip((hand, *self._points), self._points, strict=False):
                visit(self._path, start, end)
        time = self._step * self._dt
        self._step += 1
        return self._path.force(time, hand, velocity, APPARENT_MASS) + self._noise()


GRASPING = 0.7
"""Of the runs, the share in which the block is picked up."""
STOPPING = 0.5
"""Of those, the share in which the hand stops for it."""
_OFF = 0.007
"""m: how far from the block's centre it then stops at most, along each axis. A model that has seen
blocks held in one place of the hand alone does not know that they are held in another."""
_FURTHER = 3
"""Points to carry it to after the goal: more than there is time for."""
_POINTS = 6
"""Points of a tour."""
_ROOM = 0.16
"""m: how far from the block in the plane a tour goes by where it is low."""
_OVER = 0.2
"""m: how high the grasp point is where a tour may cross the block."""
_GRASPING_NOISE = 0.4
_TOURING_NOISE = 1.0
"""N; what is free may be shaken more than what must hit a block."""


class RecordingPolicy:
    """By each run's seed, takes the block up, in passing or at rest, to the goal and on, or tours
    beside it.

    All of it under noise that tells masses from drags. What carries the block shows what is held;
    a tour, what a free hand does and that a block by itself stays.
    """

    def __init__(self, stopping: float = STOPPING) -> None:
        """``stopping`` is the share of grasps at rest."""
        self._stopping = stopping
        self._scene: Scene | None = None
        self._seed = 0
        self._policy: FrankaExpert | FreeSpaceExcitation | None = None

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._scene, self._seed, self._policy = scene, seed, None

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control [3] N."""
        if self._policy is None:
            assert self._scene is not None
            random = np.random.default_rng(self._seed)
            self._policy = _policy(observation, random, self._stopping)
            self._policy.reset(self._scene, self._seed)
        return self._policy(observation)


def grasps(seed: int) -> bool:
    """Whether the run of ``seed`` is one with a grasp."""
    return bool(np.random.default_rng(seed).random() < GRASPING)


def _policy(
    observation: Observation, random: np.random.Generator, stopping: float
) -> FrankaExpert | FreeSpaceExcitation:
    if random.random() < GRASPING:
        further = [_point(random, START_HEIGHT) for _ in range(_FURTHER)]
        stops = random.random() < stopping
        stop = random.uniform(-_OFF, _OFF, 3) if stops else None
        return FrankaExpert(noise=_GRASPING_NOISE, further=further, stop=stop)
    at, block = observation["position"][[HAND, TARGET]]
    points: list[np.ndarray] = []
    while len(points) < _POINTS:
        point = _point(random, LOW[2] + EDGE)
        low = min(at[2], point[2]) < _OVER
        if not low or distance_to_way(block[:2], at[:2], point[:2], 0.0) >= _ROOM:
            points.append(point)
            at = point
    return FreeSpaceExcitation(points, noise=_TOURING_NOISE)


def _point(random: np.random.Generator, height: float) -> np.ndarray:
    """[3] m, within the region and the arm's reach, at least ``height`` m up."""
    while True:
        point = random.uniform([*(LOW[:2] + EDGE), height], HIGH - EDGE)
        if NEAR <= np.hypot(*point[:2]) <= REACH:
            return point
