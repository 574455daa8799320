"""Scripted policies of the arm: the expert's sweep, and the excitation that training data needs."""

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from scipy.interpolate import BPoly

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.exploration import CorrelatedNoise
from contactgraph.envs.pickup_layout import distance_to_path
from contactgraph_franka.envs.pickup import (
    APPARENT_MASS,
    EDGE,
    HAND,
    HIGH,
    LOW,
    START_HEIGHT,
    TARGET,
    reachable,
)

STIFFNESS = np.array([600.0, 100.0, 600.0])
"""N/m, the paper's."""
DAMPING = 4.0 * np.sqrt(STIFFNESS)
"""N s/m"""
SWEEP_SPEED = 0.38
"""Horizontal speed of the hand at the block, m/s."""
RISE = 0.06
"""Vertical speed of the hand at the block, m/s: a grasped block leaves the table at once."""
_MEAN = 0.55  # Mean speed of a segment over the sweep speed
_SHORTEST = 0.5  # Least duration of a segment from rest to rest, s
LONGEST = 3.3
"""Largest duration of a sweep, s; longer ones are sped up."""
_CORRELATION_STEPS = 10.0  # Of the noise
_GRASP_S = 0.6  # Time that a hand at rest gives its fingers to close, s

GRASPING = 0.7
"""Share of the recorded episodes with a grasp."""
STOPPING = 0.5
"""Share of those in which the hand stops to grasp."""
_GRASP_OFFSET = 0.007
"""Largest distance of that stop from the block's centre on each axis, m. A model trained
on one position in the hand does not predict contact at others."""
_FURTHER_POINTS, _FREE_POINTS = 3, 6
"""Points visited after the goal, and in free-space excitation; more than there is time for."""
_BLOCK_CLEARANCE = 0.16  # Least horizontal distance from the block of a low free-space path, m
_SAFE_HEIGHT = 0.2  # Height from which the grasp point may cross the block, m
_GRASPING_NOISE, _FREE_NOISE = 0.4, 1.0
"""N; a free hand tolerates more noise than one that must hit a block."""


class HandPath:
    """A path from rest by minimum-jerk segments, quintic in time (Flash and Hogan 1985)."""

    def __init__(self, start: np.ndarray) -> None:
        """``start`` [3] m."""
        self._times = [0.0]
        self._points = [[start, np.zeros(3), np.zeros(3)]]

    @property
    def duration(self) -> float:
        """s, of the whole path."""
        return self._times[-1]

    def append(self, end: np.ndarray, end_velocity: np.ndarray, duration: float) -> None:
        """Adds a segment of ``duration`` s to ``end`` [3] m, passed with a velocity [3] m/s."""
        self._times.append(self.duration + duration)
        self._points.append([end, end_velocity, np.zeros(3)])

    def append_rest(self, end: np.ndarray) -> None:
        """Adds a segment from rest to rest at ``end`` [3] m, at the mean speed of a sweep."""
        duration = float(np.linalg.norm(end - self._points[-1][0])) / (_MEAN * SWEEP_SPEED)
        self.append(end, np.zeros(3), max(duration, _SHORTEST))

    @cached_property
    def _polynomial(self) -> BPoly:
        return BPoly.from_derivatives(self._times, self._points)

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position m, velocity m/s and acceleration m/s^2, each [3], at ``time`` s.

        Later times give the end of the path, which must be complete.
        """
        within, path = min(time, self.duration), self._polynomial
        return path(within), path(within, 1), path(within, 2)

    def force(
        self, time: float, position: np.ndarray, velocity: np.ndarray, mass: float
    ) -> np.ndarray:
        """[3] N: spring and damper to the path, and the feed-forward of ``mass`` kg."""
        wanted, speed, acceleration = self.at(time)
        return STIFFNESS * (wanted - position) + DAMPING * (speed - velocity) + mass * acceleration


class PathPolicy:
    """Follows the path that ``plan`` makes from the first observation, with noise on the force.

    ``noise`` N as in `PickupExpert`. The mass of the hand is the scene's, or `APPARENT_MASS`.
    """

    def __init__(self, plan: Callable[[Observation], HandPath], noise: float) -> None:
        self._plan = plan
        self._noise = CorrelatedNoise(noise, _CORRELATION_STEPS)
        self._path: HandPath | None = None
        self._dt, self._mass, self._step = 0.0, APPARENT_MASS, 0

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._dt, self._path, self._step = scene.dt, None, 0
        self._mass = APPARENT_MASS if scene.mass is None else float(scene.mass[HAND])
        self._noise.reset(3, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control [3] N."""
        if self._path is None:
            self._path = self._plan(observation)
        time = self._step * self._dt
        self._step += 1
        hand, velocity = observation["position"][HAND], observation["velocity"][HAND]
        return self._path.force(time, hand, velocity, self._mass) + self._noise()


class FrankaExpert:
    """Sweeps through the block to the goal without stopping; the paper's gains.

    The hand passes the block at speed and rising. With a ``stop`` [3] m it rests at that offset
    from the block's centre until the fingers have closed. With ``further`` [K, 3] m it visits these
    points after the goal, resting at each. ``noise`` N as in `PickupExpert`.
    """

    def __init__(
        self,
        noise: float = 0.2,
        further: Sequence[np.ndarray] = (),
        stop: np.ndarray | None = None,
    ) -> None:
        self._further, self._stop = tuple(further), stop
        self._policy = PathPolicy(self._path, noise)

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` for a scene that is no pickup."""
        if scene.goal is None or scene.dimension != 3 or scene.node_count <= TARGET:
            raise InvalidInputError(
                "the arm's expert needs a goal, three dimensions and a block as node 1, found "
                f"nodes {list(scene.node_name)} of dimension {scene.dimension}"
            )
        self._policy.reset(scene, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control [3] N."""
        return self._policy(observation)

    def _path(self, observation: Observation) -> HandPath:
        hand, block = observation["position"][[HAND, TARGET]]
        goal, path = observation["goal"], HandPath(hand)
        if self._stop is None:
            _append_sweep(path, hand, block, goal)
        else:
            grasp = block + self._stop
            path.append_rest(grasp)
            path.append(grasp, np.zeros(3), _GRASP_S)
            path.append_rest(goal)
        for point in self._further:
            path.append_rest(point)
        return path


def free_space_excitation(points: Sequence[np.ndarray], noise: float = 0.2) -> PathPolicy:
    """Visits each of ``points`` [K, 3] m without a grasp, resting at each.

    Raises `InvalidInputError` for no points.
    """
    if not len(points):
        raise InvalidInputError("free-space excitation needs at least one point, found none")

    def plan(observation: Observation) -> HandPath:
        path = HandPath(observation["position"][HAND])
        for point in points:
            path.append_rest(point)
        return path

    return PathPolicy(plan, noise)


class RecordingPolicy:
    """Excitation for training data, chosen by the seed of each episode.

    It grasps the block, in passing or at rest, and carries it to the goal and further points, or
    moves through free space beside it. The noise separates masses from drags; free-space motion
    shows the dynamics of the empty hand.
    """

    def __init__(self, stopping: float = STOPPING) -> None:
        """``stopping`` is the share of grasps at rest."""
        self._stopping = stopping
        self._scene: Scene | None = None
        self._seed = 0
        self._policy: FrankaExpert | PathPolicy | None = None

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._scene, self._seed, self._policy = scene, seed, None

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control [3] N."""
        if self._policy is None:
            assert self._scene is not None
            random = np.random.default_rng(self._seed)
            self._policy = _recording_policy(observation, random, self._stopping)
            self._policy.reset(self._scene, self._seed)
        return self._policy(observation)


def grasps(seed: int) -> bool:
    """Whether `RecordingPolicy` grasps the block in the episode of ``seed``."""
    return bool(np.random.default_rng(seed).random() < GRASPING)


def _recording_policy(
    observation: Observation, random: np.random.Generator, stopping: float
) -> FrankaExpert | PathPolicy:
    if random.random() < GRASPING:
        further = [_random_point(random, START_HEIGHT) for _ in range(_FURTHER_POINTS)]
        stops = random.random() < stopping
        stop = random.uniform(-_GRASP_OFFSET, _GRASP_OFFSET, 3) if stops else None
        return FrankaExpert(noise=_GRASPING_NOISE, further=further, stop=stop)
    last, block = observation["position"][[HAND, TARGET]]
    points: list[np.ndarray] = []
    while len(points) < _FREE_POINTS:
        point = _random_point(random, LOW[2] + EDGE)
        low = min(last[2], point[2]) < _SAFE_HEIGHT
        if not low or distance_to_path(block[:2], last[:2], point[:2], 0.0) >= _BLOCK_CLEARANCE:
            points.append(point)
            last = point
    return free_space_excitation(points, noise=_FREE_NOISE)


def _append_sweep(path: HandPath, hand: np.ndarray, block: np.ndarray, goal: np.ndarray) -> None:
    """From ``hand`` through ``block`` to ``goal``, each [3] m."""
    direction = (block - hand) * [1.0, 1.0, 0.0]
    sweep = SWEEP_SPEED * direction / np.linalg.norm(direction) + [0.0, 0.0, RISE]
    first = float(np.linalg.norm(block - hand)) / (_MEAN * SWEEP_SPEED)
    second = float(np.linalg.norm(goal - block)) / (_MEAN * SWEEP_SPEED)
    speed_up = min(1.0, LONGEST / (first + second))
    path.append(block, sweep, speed_up * first)
    path.append(goal, np.zeros(3), speed_up * second)


def _random_point(random: np.random.Generator, height: float) -> np.ndarray:
    """[3] m, within the region and the arm's reach, at least ``height`` m up."""
    while True:
        point = random.uniform([*(LOW[:2] + EDGE), height], HIGH - EDGE)
        if reachable(point):
            return point
