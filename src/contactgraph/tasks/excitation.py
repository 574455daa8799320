"""Random forces: noise that makes masses identifiable, and runs that explore or rest."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.tasks.contract import Observation


class CorrelatedNoise:
    """An Ornstein-Uhlenbeck process, stationary from its first value on.

    ``deviation`` N is the standard deviation on each axis; after ``correlation_steps`` steps the
    correlation has fallen to 1/e.
    """

    def __init__(self, deviation: float, correlation_steps: float) -> None:
        if not (deviation >= 0.0 and correlation_steps > 0.0):
            raise InvalidInputError(
                f"noise needs deviation >= 0 and correlation_steps > 0, found "
                f"{deviation} and {correlation_steps}"
            )
        self._deviation = deviation
        self._keep = float(np.exp(-1.0 / correlation_steps))
        self._rng = np.random.default_rng(0)
        self._value = np.zeros(0)

    def reset(self, size: int, seed: int) -> None:
        """Starts anew with ``size`` axes."""
        self._rng = np.random.default_rng(seed)
        self._value = self._deviation * self._rng.standard_normal(size)

    def __call__(self) -> np.ndarray:
        """The next value, ``[size]`` N."""
        value = self._value
        fresh = self._deviation * self._rng.standard_normal(value.shape)
        self._value = self._keep * value + np.sqrt(1.0 - self._keep**2) * fresh
        return value


_HOMING_STIFFNESS = 3.0
_HOMING_DAMPING = 0.7


class ExplorationPolicy:
    """Wanders about with random forces and now and then hits something.

    A spring (3 N/m) to the origin and a damper (0.7 N s/m) keep it about the scene: with the
    defaults its position spreads by 0.6 m on each axis, and it hits a lone target in four runs
    of ten.
    """

    def __init__(self, deviation: float = 2.0, correlation_steps: float = 5.0) -> None:
        self._noise = CorrelatedNoise(deviation, correlation_steps)
        self._actuated = 0

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._actuated = int(np.argmax(scene.actuated))
        self._noise.reset(scene.dimension, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[D]`` N."""
        position = observation["position"][self._actuated]
        velocity = observation["velocity"][self._actuated]
        return self._noise() - _HOMING_STIFFNESS * position - _HOMING_DAMPING * velocity


class RestPolicy:
    """Does nothing: zero force."""

    def __init__(self) -> None:
        self._size = 0

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._size = scene.dimension

    def __call__(self, observation: Observation) -> np.ndarray:
        """Zeros ``[D]`` N."""
        return np.zeros(self._size)
