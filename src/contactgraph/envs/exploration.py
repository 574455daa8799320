"""Random forces: the noise of scripted policies, and exploration of any task; and rest."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation


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
        """Restarts the process with ``size`` axes."""
        self._rng = np.random.default_rng(seed)
        self._value = self._deviation * self._rng.standard_normal(size)

    def __call__(self) -> np.ndarray:
        """The next value, ``[size]`` N."""
        value = self._value
        fresh = self._deviation * self._rng.standard_normal(value.shape)
        self._value = self._keep * value + np.sqrt(1.0 - self._keep**2) * fresh
        return value


class NoisyPolicy:
    """A scripted policy that drives by forces; a subclass defines `_force`, or its own call.

    ``noise`` N is the standard deviation of a force added on each axis, correlated over two steps.
    Without it every force would be a function of the state, and mass could not be distinguished
    from drag.
    """

    def __init__(self, noise: float = 0.5) -> None:
        self._noise = CorrelatedNoise(noise, correlation_steps=2.0)

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._noise.reset(scene.dimension, seed)

    def _force(self, observation: Observation) -> np.ndarray:
        """``[D]`` N, without the noise."""
        raise NotImplementedError

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[U]`` N."""
        return self._force(observation) + self._noise()


class ExplorationPolicy:
    """Random forces that keep the gripper in the scene; it sometimes collides.

    A spring (``stiffness`` N/m) to the mean start position of nodes and goal and a damper
    (``damping`` N s/m) keep it near the scene. The defaults are for 1 kg and steps of
    0.05 s: its position spreads by 0.6 m on each axis, and it hits a lone target in one episode of
    three.
    """

    def __init__(
        self,
        deviation: float = 2.0,
        correlation_steps: float = 5.0,
        stiffness: float = 3.0,
        damping: float = 0.7,
    ) -> None:
        self._noise = CorrelatedNoise(deviation, correlation_steps)
        self._stiffness, self._damping = stiffness, damping

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._actuated = int(np.argmax(scene.actuated))
        self._home: np.ndarray | None = None
        self._noise.reset(scene.dimension, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[D]`` N."""
        if self._home is None:
            positions = np.concatenate([observation["position"], observation["goal"][None]])
            self._home = (positions.min(axis=0) + positions.max(axis=0)) / 2.0
        away = observation["position"][self._actuated] - self._home
        velocity = observation["velocity"][self._actuated]
        return self._noise() - self._stiffness * away - self._damping * velocity


class RestPolicy:
    """Does nothing: zero force, or the target where the actuated body is."""

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._scene = scene

    def __call__(self, observation: Observation) -> np.ndarray:
        """Zeros ``[U]``, but for targets in the world: there the position of their node, m."""
        kinds, acts = self._scene.control_kind, self._scene.control_of
        if kinds is None:
            return np.zeros(self._scene.dimension)
        control = np.zeros(len(kinds))
        if "position" in kinds:
            targets = [index for index, kind in enumerate(kinds) if kind == "position"]
            moved = self._scene.actuated if acts is None else acts[:, targets].any(axis=1)
            control[targets] = observation["position"][int(moved.argmax())][: len(targets)]
        return control
