"""Imperfect observation: contact sensors with errors and delay, and noise on the motion."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError, Scene, candidate_pairs, pair_indices
from contactgraph.envs.contract import Observation
from contactgraph.model import ContactSensor


class SensorFault:
    """A contact sensor that errs; a class of your own overrides `begin`."""

    exact = False
    """Whether the sensor has no fault."""

    @property
    def sensor(self) -> ContactSensor:
        """The sensor model by which beliefs are corrected."""
        return ContactSensor()

    def begin(self, scene: Scene, number: int) -> Callable[[np.ndarray], np.ndarray]:
        """The sensor at the start of a trajectory, whose ``number`` selects its random errors.

        It is called with the true contacts ``[N, N]`` bool of one step after the other, and returns
        its report, ``[N, N]``, symmetric: 1 touching, 0 not, NaN not measured.
        """
        raise NotImplementedError

    def reported(self, contact: np.ndarray, scene: Scene, number: int) -> np.ndarray:
        """[T+1, N, N]: the sensor's reports of the true ``contact`` of a trajectory."""
        sensor = self.begin(scene, number)
        return np.stack([sensor(each) for each in contact])


@dataclass(frozen=True)
class SensorFaults(SensorFault):
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
    def exact(self) -> bool:  # type: ignore[override]
        """Whether the sensor has no fault."""
        return not (self.false_alarm_rate or self.miss_rate or self.delay_steps)

    def begin(self, scene: Scene, number: int) -> Callable[[np.ndarray], np.ndarray]:
        """See `SensorFault`."""
        rng, count = np.random.default_rng([self.seed, number]), scene.node_count
        first, second = pair_indices(count).T
        candidate = candidate_pairs(scene, count)
        waiting = [np.zeros((count, count), dtype=bool)] * self.delay_steps

        def reported(contact: np.ndarray) -> np.ndarray:
            true = contact[first, second].astype(bool)
            # One random number an edge at any rate, so that a higher rate adds errors to those of
            # a lower one.
            drawn = rng.random(len(true))
            alarm = candidate & (drawn < self.false_alarm_rate)
            report = np.zeros(contact.shape, dtype=bool)
            report[first, second] = np.where(true, drawn >= self.miss_rate, alarm)
            waiting.append(report | report.T)
            return waiting.pop(0)

        return reported


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
