"""The numbers of a training: its settings, and the defaults that follow from the data."""

import math
from dataclasses import dataclass, field

import numpy as np

from contactgraph.data.dataset import Dataset
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


_CONTACT_DISTANCE = 0.085
_KEY = "contact_distance"


@dataclass(frozen=True)
class DataDefaults:
    """Arguments of the model presets and of `TrainConfig` that follow from the data."""

    contact_distance: float
    """m; from the scenes' metadata, or 0.085."""
    learned_contact_distance: bool
    """Whether the contact distance is learned. False where the metadata give it: such a scene may
    have fingers, which close on command at any distance."""
    hinges: bool
    weight: bool
    rollout_from: float
    """0 where bodies have weight, because only several steps distinguish the mass of a lifted body
    from a spring that holds it; else 0.5, which is faster."""
    control_gain: float
    """See `ModelConfig.control_gain`. By least squares where the control is a displacement or a
    velocity: an arm that follows centimetres within a step has a gain of some hundreds, and
    training would take a thousand steps to get there. Else 1."""


def defaults_from_data(dataset: Dataset) -> DataDefaults:
    """Raises `InvalidInputError` where contact distances disagree or are not positive numbers."""
    given = {each.scene.metadata.get(_KEY) for each in dataset}
    if len(given) > 1:
        raise InvalidInputError(f"{_KEY} must be the same in all trajectories, found {given}")
    distance = given.pop()
    if distance is not None and not (
        isinstance(distance, int | float) and math.isfinite(distance) and distance > 0
    ):
        raise InvalidInputError(f"{_KEY} must be positive metres, found {distance!r}")
    weight = any(each.scene.has_weight for each in dataset)
    return DataDefaults(
        contact_distance=_CONTACT_DISTANCE if distance is None else float(distance),
        learned_contact_distance=distance is None,
        hinges=any(each.scene.has_hinges for each in dataset),
        weight=weight,
        rollout_from=0.0 if weight else 0.5,
        control_gain=_control_gain(dataset),
    )


_FOLLOWED = ("displacement", "velocity")
"""Kinds of control that a body follows within about a step."""


def _control_gain(dataset: Dataset) -> float:
    """The gain g [m/s^2 a unit] of v' = c v + g dt u, over all actuated bodies that follow u."""
    rows: list[np.ndarray] = []
    for each in dataset:
        scene, kinds = each.scene, each.scene.control_kind or ()
        for component, kind in enumerate(kinds[: scene.dimension]):
            acts = scene.actuated
            if scene.control_of is not None:
                acts = acts & scene.control_of[:, component]
            if kind in _FOLLOWED:
                for node in np.flatnonzero(acts):
                    velocity = each.velocity[:, node, component]
                    control = scene.dt * each.control[:, component]
                    rows.append(np.stack([control, velocity[:-1], velocity[1:]], axis=1))
    if not rows:
        return 1.0
    table = np.concatenate(rows)
    gain = float(np.linalg.lstsq(table[:, :2], table[:, 2], rcond=None)[0][0])
    return gain if gain > 0.0 else 1.0
