"""Scripted picking: above the object, down, close the fingers, lift, carry to the goal."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.experts import CorrelatedNoise

_ABOVE = 0.08
"""m: height above the object at which the hand comes."""
_ALIGNED = 0.015
"""m beside the object within which the hand goes down."""
_DEEP = 0.01
"""m above the object's centre at which the fingers close."""
_CLOSING_S = 0.16
"""Time for which the fingers close before the hand lifts."""
_LOST = 0.05
"""m between hand and object at which a grasp has failed."""


class PickPolicy:
    """Grasps an object from above and takes it to the goal, without a model and without search.

    The control is a displacement ``[3]`` m of the hand and the fingers' command, 1 open to -1
    closed. ``speed`` m/s is the hand's, ``lead`` s as in `PushStyle`. ``noise`` m is the standard
    deviation of a displacement added on each axis. With ``variety`` above 0 every episode has its
    own speed, from ``1 - variety`` times ``speed`` to all of it.
    """

    def __init__(self, speed: float, lead: float, noise: float = 0.0, variety: float = 0.0) -> None:
        self._speed, self._lead, self._variety = speed, lead, variety
        self._noise = CorrelatedNoise(noise, correlation_steps=3.0)
        self._drawn, self._dt = speed, 1.0
        self._closing_s: float | None = None

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where nothing can be grasped."""
        wanted = ("displacement", "displacement", "displacement", "other")
        if scene.goal is None or scene.control_kind != wanted:
            raise InvalidInputError(
                f"a picking policy needs a goal and a control of {', '.join(wanted)}, found "
                f"{scene.control_kind}"
            )
        share = np.random.default_rng(seed).uniform(0.0, 1.0)
        self._drawn, self._dt = (1.0 - self._variety * share) * self._speed, scene.dt
        self._noise.reset(3, seed)
        self._closing_s = None

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[4]``: m, m, m, and the fingers' command."""
        hand, at = observation["position"]
        offset = at - hand
        if self._closing_s is not None and np.linalg.norm(offset) > _LOST:
            self._closing_s = None
        if self._closing_s is None and np.linalg.norm(offset[:2]) < _ALIGNED and -offset[2] < _DEEP:
            self._closing_s = 0.0
        if self._closing_s is None:
            beside = np.linalg.norm(offset[:2])
            above = _ABOVE if beside > _ALIGNED else 0.0
            return self._control(offset + np.array([0.0, 0.0, above]), 1.0)
        self._closing_s += self._dt
        if self._closing_s <= _CLOSING_S:
            return self._control(np.zeros(3), -1.0)
        return self._control(observation["goal"] - at, -1.0)

    def _control(self, missing: np.ndarray, fingers: float) -> np.ndarray:
        wanted = missing / (4.0 * self._dt)
        size = float(np.linalg.norm(wanted))
        if size > self._drawn:
            wanted = wanted * (self._drawn / size)
        return np.append(self._lead * wanted + self._noise(), fingers)
