"""The data of a report page: numbers with origin, trajectories, errors, reliability, losses."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.viz.edge_beliefs import BeliefTimeline
from contactgraph.viz.scene_trajectory import SceneTrajectory


@dataclass(frozen=True)
class ReportMetric:
    """One measured value and its origin. Values are in ``unit``, as displayed."""

    name: str
    """In plain words, e.g. ``"Success, 10 distractors"``."""
    value: float | None
    """None or NaN if it could not be measured."""
    unit: str = ""
    """e.g. ``"%"``, ``"cm"``, ``"ms"``; empty for a pure number."""
    interval: tuple[float, float] | None = None
    """95 % interval."""
    command: str = ""
    """The command that made it."""
    seed: int | None = None
    tile: bool = False
    """Whether it is shown large at the top of the page."""


@dataclass(frozen=True)
class NStepError:
    """N-step RMSE of positions under one test condition, beside baselines without learning."""

    condition: str
    """e.g. ``"3 distractors"``."""
    windows: str
    """Selection of windows, e.g. ``"no contact changes"``; each has its own panel."""
    model_m: float | None
    """m"""
    frozen_contact_m: float | None = None
    """m: true masses, with the contact of the window's first step kept."""
    constant_velocity_m: float | None = None
    """m: no forces."""
    standing_still_m: float | None = None
    """m: nothing moves."""
    model_interval_m: tuple[float, float] | None = None
    """95 % interval or range over seeds, m."""


@dataclass(frozen=True)
class ReliabilityCurve:
    """Reliability of one source of beliefs, see `contactgraph.evaluate.Calibration`."""

    panel: str
    """e.g. ``"one step ahead"``; each has its own panel."""
    source: str
    """e.g. ``"contacts measured"``."""
    bins: tuple[tuple[int, float, float], ...]
    """Count, mean belief and share of true labels of every bin that is not empty."""
    error: float | None = None
    """Expected calibration error."""


@dataclass(frozen=True, eq=False)
class LossCurve:
    """One loss term over training."""

    name: str
    """A term's training and held-out curves share a name, and so a colour."""
    step: np.ndarray
    """[P] training steps."""
    value: np.ndarray
    """[P] loss; values that are not positive cannot be drawn on the log axis and leave gaps."""
    held_out: bool = False

    def __post_init__(self) -> None:
        for name in ("step", "value"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        if self.step.ndim != 1 or self.step.shape != self.value.shape:
            raise InvalidInputError(
                f"loss curve {self.name!r}: step and value must both have shape (P,), "
                f"found {self.step.shape} and {self.value.shape}"
            )


@dataclass(frozen=True, eq=False)
class ReportData:
    """The content of the page. Empty parts are omitted."""

    title: str
    summary: str
    """One sentence."""
    metrics: tuple[ReportMetric, ...] = ()
    scenes: tuple[SceneTrajectory, ...] = ()
    """The first is shown first."""
    errors: tuple[NStepError, ...] = ()
    horizon_s: float | None = None
    """Prediction horizon of `errors`, s."""
    reliability: tuple[ReliabilityCurve, ...] = ()
    losses: tuple[LossCurve, ...] = ()
    beliefs: tuple[BeliefTimeline, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    """Package or machine: version."""
    remake: tuple[str, ...] = ()
    """Commands that reproduce the page, in order."""
