"""Observed motion that is not quite true: what a camera makes of it."""

import math
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.envs.contract import Observation


@dataclass(frozen=True)
class ObservationNoise:
    """White noise on every observation, the same each time.

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
        """The noise of a run. ``number`` is what tells runs' noise apart."""
        return np.random.default_rng([self.seed, number])

    def observed(self, true: Observation, rng: np.random.Generator) -> Observation:
        """What is seen of a step."""
        if not (self.position or self.velocity):
            return true
        shape = true["position"].shape
        return {
            **true,
            "position": true["position"] + self.position * rng.standard_normal(shape),
            "velocity": true["velocity"] + self.velocity * rng.standard_normal(shape),
        }
