"""The figures of the pickup study: what is asked for, and what was measured over training seeds."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ConditionResult:
    """What one model did under one test condition; JSON of the two commands, by their keys."""

    distractors: int
    open_loop: dict[str, Any]
    """Of ``contactgraph evaluate``."""
    closed_loop: dict[str, Any]
    """Of ``contactgraph control``."""
    open_loop_command: str
    closed_loop_command: str
    seed: int
    """Of the test scenes."""


@dataclass(frozen=True)
class SeedResult:
    """One training and all its test conditions."""

    seed: int
    """Of the training."""
    conditions: dict[int, ConditionResult]
    """By number of distractors."""
    training_s: float
    """Wall time of training, compilation included, s."""
    model_bytes: int
    training_command: str


@dataclass(frozen=True)
class Figure:
    """One row of the table: a figure for every training seed, and what is asked of it."""

    name: str
    unit: str
    values: tuple[float, ...]
    """One a training seed."""
    at_least: float | None
    """What it must reach."""
    aim: float | None
    lower_is_better: bool
    command: str

    @property
    def median(self) -> float:
        """Over the training seeds."""
        return statistics.median(self.values)

    @property
    def worst(self) -> float:
        """Over the training seeds."""
        return max(self.values) if self.lower_is_better else min(self.values)

    @property
    def reached(self) -> bool | None:
        """Whether the worst seed reaches what is asked; None where nothing is."""
        if self.at_least is None:
            return None
        if self.lower_is_better:
            return self.worst <= self.at_least
        return self.worst >= self.at_least


@dataclass(frozen=True)
class _Source:
    """Where a figure comes from."""

    value: Callable[[SeedResult], float | None]
    command: Callable[[SeedResult], str]


@dataclass(frozen=True)
class _Asked:
    """A figure before it is measured."""

    name: str
    unit: str
    source: _Source
    at_least: float | None = None
    aim: float | None = None
    lower_is_better: bool = True


def pickup_figures(results: Sequence[SeedResult]) -> list[Figure]:
    """Every figure of the pickup task, in the order of the table, one value a training seed."""
    every = list(results[0].conditions)
    some, most = [count for count in every if count], max(every)
    asked = [
        _Asked("N-step error", "cm", _predicted("n_step_rmse_m", 0, 100.0), 0.5, 0.2),
        _Asked("the same, share of the frozen-contact floor", "", _against_floor(), 0.25),
    ]
    for count in some:
        name = f"error of moving bodies, {count} distractors against none"
        asked.append(_Asked(name, "times", _against_none(count), 1.2, 1.0))
    name = f"N-step error, {most} distractors, all nodes"
    asked.append(_Asked(name, "cm", _predicted("n_step_rmse_m", most, 100.0), 0.3, 0.1))
    for count in (0, most):
        name = f"edge F1, {_distractors(count)}"
        asked.append(_Asked(name, "", _predicted("edge_f1", count), 0.97, 0.99, False))
    for count in every:
        name = f"success, {_distractors(count)}"
        source = _controlled("success_rate", count, 100.0)
        asked.append(_Asked(name, "%", source, 98.0, 100.0, False))
    speed, slowest = "contact_speed_m_s", "slowest_before_contact_min_m_s"
    tick = f"control tick, horizon 20, {most + 1} objects, 99 %"
    asked += [
        _Asked("speed at contact, median", "m/s", _controlled(speed, 0), 0.3, None, False),
        _Asked("slowest on the way there, any episode", "m/s", _controlled(slowest, 0)),
        _Asked("training", "s", _trained(lambda result: result.training_s), 120.0, 30.0),
        _Asked(tick, "ms", _controlled("plan_ms_p99", most), 10.0, 3.0),
        _Asked("model file", "MB", _trained(lambda result: result.model_bytes / 1e6), 1.0),
    ]
    return [
        Figure(
            name=one.name,
            unit=one.unit,
            values=tuple(_number(one.source.value(result)) for result in results),
            at_least=one.at_least,
            aim=one.aim,
            lower_is_better=one.lower_is_better,
            command=one.source.command(results[0]),
        )
        for one in asked
    ]


def _predicted(key: str, distractors: int, scale: float = 1.0) -> _Source:
    return _Source(
        lambda result: _scaled(result.conditions[distractors].open_loop[key], scale),
        lambda result: result.conditions[distractors].open_loop_command,
    )


def _controlled(key: str, distractors: int, scale: float = 1.0) -> _Source:
    return _Source(
        lambda result: _scaled(result.conditions[distractors].closed_loop[key], scale),
        lambda result: result.conditions[distractors].closed_loop_command,
    )


def _trained(value: Callable[[SeedResult], float]) -> _Source:
    return _Source(value, lambda result: result.training_command)


def _against_floor() -> _Source:
    def value(result: SeedResult) -> float | None:
        loop = result.conditions[0].open_loop
        return _ratio(loop["n_step_rmse_m"], loop["frozen_contact_rmse_m"])

    return _Source(value, lambda result: result.conditions[0].open_loop_command)


def _against_none(distractors: int) -> _Source:
    def value(result: SeedResult) -> float | None:
        with_them, without = result.conditions[distractors], result.conditions[0]
        key = "n_step_rmse_moving_m"
        return _ratio(with_them.open_loop[key], without.open_loop[key])

    return _Source(value, lambda result: result.conditions[distractors].open_loop_command)


def _distractors(distractors: int) -> str:
    return f"{distractors} distractors" if distractors else "no distractors"


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else scale * value


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else value / reference
