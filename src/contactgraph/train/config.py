"""The numbers of a training."""

import math
from dataclasses import dataclass, field

from contactgraph.data.errors import InvalidInputError
from contactgraph.train.loss import LossTerms


@dataclass(frozen=True)
class TrainConfig:
    """Every number that shapes the result of a training.

    Raises `InvalidInputError` naming the first number that is out of range.
    """

    steps: int = 2000
    """Optimiser steps."""
    batch_size: int = 32
    """Windows a step."""
    window_length: int = 8
    """Steps of a window."""
    learning_rate: float = 3e-3
    """Highest rate of Adam; it rises over the first 100 steps and falls along a cosine."""
    event_fraction: float = 0.6
    """Share of windows that hold an impact."""
    rollout_from: float = 0.5
    """Part of the steps after which the rollout term joins the loss."""
    bystanders: int = 1
    """Resting distractors added to every window; none where the data never show a body at rest."""
    patience: int = 12
    """Checks of the held-out error without improvement after which training stops."""
    check_every: int = 125
    """Optimiser steps between checks."""
    use_contacts: bool = False
    """Whether recorded contacts, too, correct the filter that is trained."""
    weights: LossTerms = field(default_factory=LossTerms)
    """Weights of the terms of the loss."""

    def __post_init__(self) -> None:
        for name, (lowest, highest) in _BOUNDS.items():
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise InvalidInputError(f"{name} must be {lowest} to {highest}, found {value}")
        if not (self.learning_rate > 0 and math.isfinite(self.learning_rate)):
            raise InvalidInputError(
                f"learning_rate must be positive and finite, found {self.learning_rate}"
            )


_BOUNDS = {
    "steps": (1, 10**9),
    "batch_size": (1, 65536),
    "window_length": (1, 10**6),
    "event_fraction": (0, 1),
    "rollout_from": (0, 1),
    "bystanders": (0, 100),
    "patience": (1, 10**9),
    "check_every": (1, 10**9),
}
