"""Scripted policies of the billiards task: an expert, and one that strikes at random."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.billiards import CUE, DT, GROUND_FRICTION, RESTITUTION, TABLE
from contactgraph.envs.contract import Observation
from contactgraph.envs.experts import CorrelatedNoise
from contactgraph.envs.planar.body import GRAVITY

STAND_OFF = 0.18
"""Distance of the two surfaces before the run-up, m."""
TIME_CONSTANT = 0.08
"""Of the cue's approach to a wanted velocity, s."""
STRAIGHT = np.array([0.01, 0.03])
"""Distance of the cue from the line of the shot, at most: to begin the run-up, to go on; m."""
AT_REST = 0.02
"""Speed below which the target is struck, m/s."""
NEAR_GOAL = 0.06
"""The target is left alone within this distance of the goal, m."""
CRUISE = 0.9
"""Speed of the cue on its way behind the target, at most, m/s."""
CLEARANCE = 0.14
"""Distance of two surfaces at which the cue begins to turn aside, m."""
BRAKING = 0.03
"""Distance from a wall at which the cue begins to brake, m."""
DETOUR = 0.4
"""Length of a shot that does not lead to the goal, at most, m."""
_TURNS = np.deg2rad([turn for step in range(19) for turn in (10 * step, -10 * step)])


class BilliardsExpert:
    """Goes behind the target, on the line to the goal, and strikes it so that it stops there.

    The speed of the strike follows from the distance, the friction with the table and the law of
    the impact. A target that would stop elsewhere is struck again. ``noise`` N is the standard
    deviation of a force added on each axis, correlated over ``correlation_steps`` steps.
    """

    def __init__(self, noise: float = 0.5, correlation_steps: float = 2.0) -> None:
        self._noise = CorrelatedNoise(noise, correlation_steps)
        self._target = 1
        self._mass = np.ones(0)
        self._radius = np.ones(0)

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where ``scene`` is no billiards."""
        there = "target" in scene.node_name and scene.actuated[CUE]
        if not there or scene.mass is None or scene.radius is None:
            raise InvalidInputError(
                "a billiards expert needs an actuated node 0, a node named target, masses and "
                f"radii, found nodes {list(scene.node_name)}"
            )
        self._target = scene.node_name.index("target")
        self._mass, self._radius = scene.mass, scene.radius
        self._noise.reset(scene.dimension, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N."""
        position, velocity = observation["position"], observation["velocity"]
        shot = np.asarray(observation["goal"] - position[self._target])
        resting = np.linalg.norm(velocity[self._target]) <= AT_REST
        wanted = np.zeros(2)
        if resting and np.linalg.norm(shot) > NEAR_GOAL:
            wanted = self._velocity(position, velocity[CUE], self._feasible(position, shot))
        force = self._mass[CUE] * (wanted - velocity[CUE]) / TIME_CONSTANT
        return force + self._noise()

    def _feasible(self, position: np.ndarray, shot: np.ndarray) -> np.ndarray:
        """[2] m: the shot, turned as little as gives the cue a free position behind the target."""
        reach = self._radius[CUE] + self._radius
        others = [n for n in range(1, len(position)) if n != self._target]
        for turn in _TURNS:
            cos, sin = np.cos(turn), np.sin(turn)
            turned = np.array([cos * shot[0] - sin * shot[1], sin * shot[0] + cos * shot[1]])
            behind = self._behind(position, turned)
            apart = np.linalg.norm(position[others] - behind, axis=-1) - reach[others]
            inside = np.all(np.abs(behind) < TABLE - self._radius[CUE] - 0.5 * BRAKING)
            if inside and np.all(apart > 0.5 * CLEARANCE):
                return turned if turn == 0.0 else turned * min(1.0, DETOUR / np.hypot(*shot))
        return shot

    def _behind(self, position: np.ndarray, shot: np.ndarray) -> np.ndarray:
        distance = self._radius[CUE] + self._radius[self._target] + STAND_OFF
        return np.asarray(position[self._target] - distance * shot / np.linalg.norm(shot))

    def _velocity(self, position: np.ndarray, velocity: np.ndarray, shot: np.ndarray) -> np.ndarray:
        """[2] m/s, wanted of the cue."""
        length = float(np.linalg.norm(shot))
        ahead = shot / length
        offset = position[CUE] - position[self._target]
        along = float(offset @ ahead)
        aside = offset - along * ahead
        running = float(velocity @ ahead) > 0.3
        if along < 0.0 and np.linalg.norm(aside) < STRAIGHT[int(running)]:
            share = self._mass[CUE] / (self._mass[CUE] + self._mass[self._target])
            after = np.sqrt(2.0 * (GRAVITY * GROUND_FRICTION) * length)
            strike = after / ((1.0 + RESTITUTION) * share)
            return np.asarray(strike * ahead - aside / (2.0 * TIME_CONSTANT))
        way = self._behind(position, shot) - position[CUE]
        wanted = way * min(0.4 / TIME_CONSTANT, CRUISE / max(float(np.linalg.norm(way)), 1e-9))
        for node in range(1, len(position)):
            reach = float(self._radius[CUE] + self._radius[node])
            clearance = STAND_OFF if node == self._target else CLEARANCE
            wanted = _turned_aside(wanted, position[CUE] - position[node], reach, clearance)
        for axis in range(2):
            gap = TABLE[axis] - self._radius[CUE] - abs(position[CUE, axis])
            if gap < BRAKING and wanted[axis] * position[CUE, axis] > 0.0:
                wanted[axis] *= max(gap, 0.0) / BRAKING
        return wanted


def _turned_aside(
    wanted: np.ndarray, away: np.ndarray, reach: float, clearance: float
) -> np.ndarray:
    """``wanted`` [2] m/s without its part towards a near disc, and around the disc instead."""
    distance = float(np.linalg.norm(away))
    normal = away / distance
    closing = -float(wanted @ normal)
    nearness = min(1.0 - (distance - reach) / clearance, 1.0)
    if nearness <= 0.0 or closing <= 0.0:
        return wanted
    tangent = np.array([-normal[1], normal[0]])
    side = 1.0 if wanted @ tangent >= 0.0 else -1.0
    return np.asarray(wanted + nearness * closing * (1.5 * normal + side * tangent))


class StrikingPolicy:
    """Drives the cue at one object after the other, drawn at random: for exploration.

    It chooses every ``hold`` steps, and a speed of up to ``fastest`` m/s.
    """

    def __init__(self, hold: int = 25, fastest: float = 1.5, noise: float = 0.5) -> None:
        self._hold, self._fastest = hold, fastest
        self._noise = CorrelatedNoise(noise, 2.0)
        self._rng = np.random.default_rng(0)
        self._objects = np.zeros(0, dtype=int)
        self._step = 0
        self._aim, self._speed = 0, 0.0

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._objects = np.flatnonzero(scene.passive)
        self._rng = np.random.default_rng(seed)
        self._noise.reset(scene.dimension, seed)
        self._step = 0

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N."""
        if self._step % self._hold == 0:
            self._aim = int(self._rng.choice(self._objects))
            self._speed = float(self._rng.uniform(0.3, self._fastest))
        self._step += 1
        way = observation["position"][self._aim] - observation["position"][CUE]
        wanted = self._speed * way / max(float(np.linalg.norm(way)), DT)
        force = (wanted - observation["velocity"][CUE]) / TIME_CONSTANT
        return force + self._noise()
