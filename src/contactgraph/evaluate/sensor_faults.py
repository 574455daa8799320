"""Imperfect observation: contact sensors with errors and delay, and noise on the motion."""

import math
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError, Scene, candidate_pairs, pair_indices
from contactgraph.envs.contract import Observation
from contactgraph.model import ContactSensor


@dataclass(frozen=True)
class SensorFaults:
    """Errors of a contact sensor, independent for every edge and step, and reproducible.

    Errors come before the delay: at step t the sensor reports its reading of step
    t - ``delay_steps``, and no contact before the first reading. Raises `InvalidInputError` for a
    rate outside [0, 1) or a delay below 0.
    """

    false_alarm_rate: float = 0.0
    """Share of candidate edges without contact that are read as touching."""
    miss_rate: float = 0.0
    """Share of touching edges that are read as free."""
    delay_steps: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("false_alarm_rate", "miss_rate"):
            rate = getattr(self, name)
            if not (math.isfinite(rate) and 0.0 <= rate < 1.0):
                raise InvalidInputError(f"{name} must be at least 0 and below 1, found {rate}")
        if self.delay_steps < 0:
            raise InvalidInputError(f"delay_steps must be at least 0, found {self.delay_steps}")

    @property
    def sensor(self) -> ContactSensor:
        """The sensor model of a correction that knows the rates and the delay.

        Its rates are never below those assumed of an exact sensor.
        """
        usual = ContactSensor()
        return ContactSensor(
            false_alarm=max(self.false_alarm_rate, usual.false_alarm),
            miss=max(self.miss_rate, usual.miss),
            delay=self.delay_steps,
        )

    @property
    def exact(self) -> bool:
        """Whether the sensor has no fault."""
        return not (self.false_alarm_rate or self.miss_rate or self.delay_steps)

    def begin(self, scene: Scene, number: int) -> "FaultySensor":
        """The sensor at the start of a trajectory, whose ``number`` selects its random errors."""
        return FaultySensor(self, scene, np.random.default_rng([self.seed, number]))

    def reported(self, contact: np.ndarray, scene: Scene, number: int) -> np.ndarray:
        """[T+1, N, N] bool: the sensor's reports of the true ``contact`` of a trajectory."""
        sensor = self.begin(scene, number)
        return np.stack([sensor(each) for each in contact])


class FaultySensor:
    """A sensor that reads true contacts step by step and reports them with faults."""

    def __init__(self, faults: SensorFaults, scene: Scene, rng: np.random.Generator) -> None:
        self._faults = faults
        self._rng = rng
        self._pairs = pair_indices(scene.node_count)
        self._candidate = candidate_pairs(scene, scene.node_count)
        nothing: np.ndarray = np.zeros((scene.node_count, scene.node_count), dtype=bool)
        self._waiting = [nothing] * faults.delay_steps

    def __call__(self, contact: np.ndarray) -> np.ndarray:
        """[N, N] bool, symmetric: the report at a step in which ``contact`` [N, N] holds."""
        first, second = self._pairs.T
        true = contact[first, second].astype(bool)
        # One random number an edge at any rate, so that a higher rate adds errors to those of a
        # lower one.
        drawn = self._rng.random(len(true))
        alarm = self._candidate & (drawn < self._faults.false_alarm_rate)
        read = np.where(true, drawn >= self._faults.miss_rate, alarm)
        report = np.zeros(contact.shape, dtype=bool)
        report[first, second] = report[second, first] = read
        self._waiting.append(report)
        return self._waiting.pop(0)


@dataclass(frozen=True)
class ObservationNoise:
    """Reproducible white noise on every observation.

    Raises `InvalidInputError` for a number that is no standard deviation.
    """

    position: float = 0.0
    """Standard deviation on each axis, m."""
    velocity: float = 0.0
    """m/s"""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("position", "velocity"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InvalidInputError(f"{name} must be at least 0 and finite, found {value}")

    def begin(self, number: int) -> np.random.Generator:
        """The noise of a trajectory, selected by its ``number``."""
        return np.random.default_rng([self.seed, number])

    def observed(self, true: Observation, rng: np.random.Generator) -> Observation:
        """The observation with noise."""
        if not (self.position or self.velocity):
            return true
        shape = true["position"].shape
        return {
            **true,
            "position": true["position"] + self.position * rng.standard_normal(shape),
            "velocity": true["velocity"] + self.velocity * rng.standard_normal(shape),
        }
