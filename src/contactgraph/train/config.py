"""The numbers of a training: its settings, and the defaults that follow from the data."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from contactgraph.data.actuation_fit import (
    ActuationFit,
    checked_driving_components,
    distances,
    fit_actuation,
    fit_slowing,
    fit_theta,
)
from contactgraph.data.dataset import Dataset, masses_vary
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.impact_fit import Impacts, fit_impacts
from contactgraph.data.trajectory import Trajectory
from contactgraph.train.loss import LossTerms
from contactgraph.train.turning import (
    find_turning,
    has_outline,
    outline_distances,
    plane_distances,
    round_distances,
)


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


CONTACT_DISTANCE = 0.085
"""m; where data do not tell, about the distance at which bodies touch."""
_AVERAGED = 0.95
"""Share of a change of velocity that displaces in its step, from which velocities are means."""
_MOVES, _LEAST_BEGINNINGS = 0.02, 10
"""Share of a trajectory's greatest speed from which a body moves; and how often that must begin for
the distance of contact to be seen from it."""
_FARTHER = 0.9
"""Quantile of these distances: of bodies that are no discs, most touch when they are nearer."""
_SAME = 0.01
"""Spread of these distances from which training learns the distance: impacts would lead away."""
_KEY = "contact_distance"
_BOUNCES, _SLIDES = 0.02, 1e-3
"""Bounce, and deceleration by the ground in m/s^2, up to which there is none."""


@dataclass(frozen=True)
class BodyDefaults:
    """Arguments of the preset `ours` that follow from the data: see `ModelConfig`."""

    contact_distance: float
    """m; from the scenes' metadata, or about the distance at which bodies begin to move."""
    learned_contact_distance: bool
    """Not where velocities are means over a step, which do not tell when in it bodies met."""
    node_types: tuple[str, ...]
    actuation: dict[str, ActuationFit]
    driving_size: int
    actuated_nodes: int
    plane_distance: dict[str, float]
    averaged: bool
    boxes: bool
    theta: float
    turn_length: float | None
    margin: float
    inertia: dict[str, np.ndarray]
    substeps: int
    slowing: dict[str, tuple[float, float]]
    impacts: dict[tuple[str, str], Impacts]
    varying_mass: bool
    rough: bool
    friction: float
    identified: bool


@dataclass(frozen=True)
class DataDefaults:
    """Arguments of the model presets and of `TrainConfig` that follow from the data."""

    contact_distance: float
    """m; from the scenes' metadata, or 0.085."""
    learned_contact_distance: bool
    """Whether the contact distance is learned. False where the metadata give it: such a scene may
    have fingers, which close on command at any distance."""
    hinges: bool
    rollout_from: float
    """0 where bodies have weight, because only several steps distinguish the mass of a lifted body
    from a spring that holds it; else 0.5, which is faster."""


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
        contact_distance=CONTACT_DISTANCE if distance is None else float(distance),
        learned_contact_distance=distance is None,
        hinges=any(each.scene.has_hinges for each in dataset),
        rollout_from=0.0 if weight else 0.5,
    )


def body_defaults(dataset: Dataset) -> BodyDefaults:
    """Raises `InvalidInputError` as `defaults_from_data`, where commands precede what drives, or
    where what drives acts on no node."""
    common = defaults_from_data(dataset)
    drives = checked_driving_components(dataset)
    theta = fit_theta(dataset)
    averaged = theta > _AVERAGED
    distance, boxes, margin, spread = common.contact_distance, False, 0.0, np.inf
    turning = find_turning(dataset)
    outlined = turning and all(has_outline(each.scene).all() for each in dataset)
    if common.learned_contact_distance and turning is not None:
        # Bodies with an outline touch where these meet.
        distance = turning.size
        if not outlined:
            distance = _contact_distance(dataset, round_distances).distance
    elif common.learned_contact_distance:
        round_, box = (
            _contact_distance(dataset, partial(distances, boxes=each)) for each in (False, True)
        )
        # Shapes that are right let bodies touch at one distance.
        boxes = box.spread < round_.spread
        distance, spread = box if boxes else round_
    actuation = fit_actuation(dataset, 1.0 if averaged else theta)
    apart = partial(distances, boxes=boxes)
    if turning is not None:
        apart = partial(outline_distances, contact_distance=distance)
        if outlined and common.learned_contact_distance and dataset.dimension == 3:
            margin = _contact_distance(dataset, apart).distance - distance
    substeps = 1 if turning is None or averaged else turning.substeps
    slowing = fit_slowing(dataset, distance, apart)
    borne = frozenset[str]() if turning is None else turning.borne
    impacts = {} if averaged or turning is not None else fit_impacts(dataset, actuation)
    planes = any(each.scene.planes is not None and len(each.scene.planes) for each in dataset)
    slides = any(constant > _SLIDES for constant, _ in slowing.values())
    bounces = any(each.bounce > _BOUNCES for each in impacts.values())
    unknown = averaged or turning is not None or planes
    rubs = unknown or any(each.friction is not None for each in impacts.values())
    return BodyDefaults(
        contact_distance=distance,
        # Outlines tell it; of bodies at rest nothing else does.
        learned_contact_distance=common.learned_contact_distance
        and not (averaged or outlined or spread < _SAME),
        node_types=_node_types(dataset),
        actuation=actuation,
        driving_size=int(drives.sum()),
        actuated_nodes=max(1, *(int(each.scene.actuated.sum()) for each in dataset)),
        plane_distance=plane_distances(dataset, {} if turning is None else turning.inertia),
        averaged=averaged,
        boxes=boxes,
        theta=float(np.clip(0.5 + substeps * (theta - 0.5), 0.51, 0.99)),
        turn_length=None if turning is None else turning.turn_length,
        margin=margin,
        inertia={} if turning is None else turning.inertia,
        substeps=substeps,
        slowing={name: found for name, found in slowing.items() if name not in borne},
        # Of means over a step nothing tells the velocities before and after; and those of bodies
        # that turn, nothing but the whole step.
        impacts=impacts,
        varying_mass=masses_vary(dataset),
        rough=rubs or slides or bounces,
        friction=1.0 if rubs else 0.0,
        identified=turning is not None and turning.undriven and bool(outlined),
    )


def _node_types(dataset: Dataset) -> tuple[str, ...]:
    """Names of the types, passive ones first, the most frequent first."""
    count: Counter[tuple[bool, str]] = Counter()
    for each in dataset:
        count.update(zip(each.scene.actuated.tolist(), each.scene.node_type, strict=True))
    names = sorted(count, key=lambda each: (each[0], -count[each], each[1]))
    return tuple(dict.fromkeys(name for _, name in names))


class _Touching(NamedTuple):
    distance: float
    """m"""
    spread: float
    """From the first to the last tenth, in units of the distance; infinite where not known."""


def _contact_distance(dataset: Dataset, distances: Callable[[Trajectory], np.ndarray]) -> _Touching:
    """The distance from the nearest body at which bodies that rest begin to move.

    Where that is hardly ever seen: how near bodies come to each other in some trajectories.
    ``distances`` [T+1, N, N] m are those of a trajectory.
    """
    if any(each.scene.has_hinges for each in dataset):
        return _Touching(CONTACT_DISTANCE, np.inf)  # is that from a bar's middle line
    begins: list[np.ndarray] = []
    nearest: list[float] = []
    for each in dataset:
        apart = np.min(distances(each), axis=-1)
        if not np.isfinite(apart).any():
            continue  # of one body, or of outlines alone
        speed = np.linalg.norm(each.velocity, axis=-1)
        moves = speed > _MOVES * speed.max(initial=0.0)
        begin = ~moves[:-1] & moves[1:] & ~each.scene.actuated
        begins.append(np.minimum(apart[:-1], apart[1:])[begin])
        nearest.append(float(apart.min()))
    found = np.concatenate(begins) if begins else np.zeros(0)
    share, spread = _FARTHER, np.inf
    if len(found) < _LEAST_BEGINNINGS:
        found, share = np.array(nearest), 1.0 - _FARTHER
    elif np.median(found) > 0.0:
        spread = float(np.diff(np.quantile(found, [1.0 - _FARTHER, _FARTHER]))[0])
        spread = spread / float(np.median(found))
    distance = float(np.quantile(found, share)) if len(found) else 0.0
    return _Touching(distance if distance > 0.0 else CONTACT_DISTANCE, spread)
