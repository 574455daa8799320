"""Scripted policies of the arm: the expert's sweep, and the excitation that training data needs."""

from collections.abc import Callable, Sequence

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.experts import CorrelatedNoise
from contactgraph.envs.pickup_layout import distance_to_way
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
    """A sequence of minimum-jerk segments, quintic in time (Flash and Hogan 1985)."""

    def __init__(self) -> None:
        self._segments: list[tuple[float, float, np.ndarray]] = []
        self.duration = 0.0
        """s, of the whole path."""

    def append(
        self,
        start: np.ndarray,
        start_velocity: np.ndarray,
        end: np.ndarray,
        end_velocity: np.ndarray,
        duration: float,
    ) -> None:
        """Adds a segment of ``duration`` s; positions [3] m, velocities [3] m/s."""
        coefficients = _quintic(start, start_velocity, end, end_velocity, duration)
        self._segments.append((self.duration, duration, coefficients))
        self.duration += duration

    def append_rest_to_rest(self, start: np.ndarray, end: np.ndarray) -> None:
        """Adds a segment between two positions [3] m at rest, at the mean speed of a sweep."""
        rest = np.zeros(3)
        duration = float(np.linalg.norm(end - start)) / (_MEAN * SWEEP_SPEED)
        self.append(start, rest, end, rest, max(duration, _SHORTEST))

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position m, velocity m/s and acceleration m/s^2, each [3], at ``time`` s.

        Later times give the end of the path.
        """
        begin, duration, coefficients = [s for s in self._segments if s[0] <= time][-1]
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
        """[3] N: spring and damper to the path, and the feed-forward of ``mass`` kg."""
        wanted, speed, acceleration = self.at(time)
        return STIFFNESS * (wanted - position) + DAMPING * (speed - velocity) + mass * acceleration


class PathPolicy:
    """Follows the path that ``plan`` makes from the first observation, with noise on the force.

    ``noise`` N as in `PickupExpert`. The mass of the hand is the scene's, or `APPARENT_MASS`.
    """

    def __init__(
        self, plan: Callable[[Observation], HandPath], noise: float, correlation_steps: float = 10.0
    ) -> None:
        self._plan = plan
        self._noise = CorrelatedNoise(noise, correlation_steps)
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
        correlation_steps: float = 10.0,
        further: Sequence[np.ndarray] = (),
        stop: np.ndarray | None = None,
    ) -> None:
        self._further, self._stop = tuple(further), stop
        self._policy = PathPolicy(self._path, noise, correlation_steps)

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
        goal, path = observation["goal"], HandPath()
        if self._stop is None:
            _append_sweep(path, hand, block, goal)
        else:
            rest, grasp = np.zeros(3), block + self._stop
            path.append_rest_to_rest(hand, grasp)
            path.append(grasp, rest, grasp, rest, _GRASP_S)
            path.append_rest_to_rest(grasp, goal)
        _append_visits(path, goal, self._further)
        return path


def free_space_excitation(
    points: Sequence[np.ndarray], noise: float = 0.2, correlation_steps: float = 10.0
) -> PathPolicy:
    """Visits each of ``points`` [K, 3] m without a grasp, resting at each.

    Raises `InvalidInputError` for no points.
    """
    if not len(points):
        raise InvalidInputError("free-space excitation needs at least one point, found none")

    def plan(observation: Observation) -> HandPath:
        path = HandPath()
        _append_visits(path, observation["position"][HAND], points)
        return path

    return PathPolicy(plan, noise, correlation_steps)


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
        if not low or distance_to_way(block[:2], last[:2], point[:2], 0.0) >= _BLOCK_CLEARANCE:
            points.append(point)
            last = point
    return free_space_excitation(points, noise=_FREE_NOISE)


def _append_sweep(path: HandPath, hand: np.ndarray, block: np.ndarray, goal: np.ndarray) -> None:
    """From ``hand`` through ``block`` to ``goal``, each [3] m."""
    direction = (block - hand) * [1.0, 1.0, 0.0]
    sweep = SWEEP_SPEED * direction / np.linalg.norm(direction) + [0.0, 0.0, RISE]
    rest = np.zeros(3)
    first = float(np.linalg.norm(block - hand)) / (_MEAN * SWEEP_SPEED)
    second = float(np.linalg.norm(goal - block)) / (_MEAN * SWEEP_SPEED)
    speed_up = min(1.0, LONGEST / (first + second))
    path.append(hand, rest, block, sweep, speed_up * first)
    path.append(block, sweep, goal, rest, speed_up * second)


def _append_visits(path: HandPath, start: np.ndarray, points: Sequence[np.ndarray]) -> None:
    for point in points:
        path.append_rest_to_rest(start, point)
        start = point


def _random_point(random: np.random.Generator, height: float) -> np.ndarray:
    """[3] m, within the region and the arm's reach, at least ``height`` m up."""
    while True:
        point = random.uniform([*(LOW[:2] + EDGE), height], HIGH - EDGE)
        if reachable(point):
            return point


def _quintic(
    start: np.ndarray,
    start_velocity: np.ndarray,
    end: np.ndarray,
    end_velocity: np.ndarray,
    duration: float,
) -> np.ndarray:
    """[6, 3]: coefficients of the position over s in [0, 1], without acceleration at the ends."""
    displacement = end - start - duration * start_velocity
    change = duration * (end_velocity - start_velocity)
    return np.stack(
        [
            start,
            duration * start_velocity,
            np.zeros(3),
            10.0 * displacement - 4.0 * change,
            -15.0 * displacement + 7.0 * change,
            6.0 * displacement - 3.0 * change,
        ]
    )
