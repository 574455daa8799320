"""A tour of the arm's hand that grasps nothing: what a free hand does under a force."""

from collections.abc import Sequence

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.excitation import CorrelatedNoise
from contactgraph_franka.envs.franka_expert import visit
from contactgraph_franka.envs.franka_pickup import APPARENT_MASS, HAND
from contactgraph_franka.envs.hand_path import HandPath


class FrankaTour:
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
