"""Intervals of numbers of several trainings that were tested in the same scenes."""

import enum
import math
import warnings
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from contactgraph.viz.metric_table import short, with_unit

DRAWS = 2000
_ENDS = (0.025, 0.975)


class Verdict(enum.StrEnum):
    """Whether something holds."""

    HOLDS = "holds"
    FAILS = "does not hold"
    UNDECIDED = "cannot tell"
    UNKNOWN = "not measured"


def all_hold(verdicts: Sequence[Verdict]) -> Verdict:
    """Of several conditions: one that fails decides, then one that is not known."""
    for decides in (Verdict.FAILS, Verdict.UNKNOWN, Verdict.UNDECIDED):
        if decides in verdicts or not verdicts:
            return decides if verdicts else Verdict.UNKNOWN
    return Verdict.HOLDS


def mean(values: np.ndarray) -> np.ndarray:
    """Of the known values along the last axis; NaN without any."""
    known = ~np.isnan(values)
    count = known.sum(axis=-1)
    total = np.sum(values, axis=-1, where=known)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def root_mean_square(values: np.ndarray) -> np.ndarray:
    """See `mean`."""
    return np.sqrt(mean(values**2))


@dataclass(frozen=True)
class Sample:
    """A number of every training, from one value a scene or a single one."""

    by_training: Mapping[int, np.ndarray]
    """By training seed: NaN where not known, infinite where a prediction diverged."""
    scenes: Hashable
    """Samples of equal scenes are drawn together."""
    summary: Callable[[np.ndarray], np.ndarray] = root_mean_square
    """The number of a training, along the last axis."""
    unit: str = ""
    command: str = ""

    def numbers(self, seed: int, drawn: np.ndarray) -> np.ndarray:
        """[B] of one training in the scenes of each draw [B, S]."""
        values = self.by_training[seed]
        return self.summary(
            values[drawn] if len(values) > 1 else np.broadcast_to(values, (len(drawn), 1))
        )


@dataclass(frozen=True)
class Estimate:
    """A statistic of trainings with its interval of 95 %."""

    value: float = math.nan
    """Median over trainings; NaN: not known."""
    low: float = math.nan
    high: float = math.nan
    each: tuple[float, ...] = ()
    """Of each training."""
    unit: str = ""
    command: str = ""
    trainings: int = 0
    """That were tested; a controller that moves nothing has no error, for example."""

    def below(self, bound: float) -> Verdict:
        """Whether the whole interval lies below a bound."""
        return self.within(-math.inf, np.nextafter(bound, -math.inf))

    def within(self, least: float, most: float) -> Verdict:
        """Whether the whole interval lies within bounds, or outside of them."""
        if not self.trainings:
            return Verdict.UNKNOWN
        if least <= self.low and self.high <= most:
            return Verdict.HOLDS
        return Verdict.FAILS if self.high < least or self.low > most else Verdict.UNDECIDED

    def above(self, bound: float) -> Verdict:
        """Whether the whole interval lies above a bound."""
        return self.within(np.nextafter(bound, math.inf), math.inf)

    def __str__(self) -> str:
        """The value with its interval and unit."""
        if math.isnan(self.value):
            return "unknown" if self.trainings else "not measured"
        if self.low == self.high:
            return with_unit(self.value, self.unit)
        return f"{with_unit(self.value, self.unit)} ({short(self.low)} to {short(self.high)})"


def estimate(
    samples: Sequence[Sample], statistic: Callable[..., np.ndarray] | None = None, unit: str = ""
) -> Estimate:
    """A statistic of the samples' numbers of a training, as the median over trainings.

    ``statistic`` takes an array of each sample; None: the only sample's own number. The interval is
    that between percentiles of 2,000 draws, with replacement, of trainings, the same of all
    samples, and of scenes (Efron 1979). Not known without a training that all samples have.
    """
    seeds = sorted(set.intersection(*(set(one.by_training) for one in samples)))
    unit = samples[0].unit if statistic is None else unit
    if not seeds:
        return Estimate(unit=unit)
    rng = np.random.default_rng(0)
    drawn: dict[Hashable, np.ndarray] = {}
    for one in samples:
        count = len(one.by_training[seeds[0]])
        if one.scenes not in drawn and count > 1:
            again = rng.integers(count, size=(DRAWS, count))
            drawn[one.scenes] = np.concatenate([np.arange(count)[None], again])
    single = np.zeros((1 + DRAWS, 1), int)
    chosen = [drawn.get(one.scenes, single) for one in samples]
    made: list[np.ndarray] = []
    with np.errstate(all="ignore"):  # of infinite numbers
        for seed in seeds:
            numbers = [one.numbers(seed, d) for one, d in zip(samples, chosen, strict=True)]
            made.append(numbers[0] if statistic is None else statistic(*numbers))
    of_seed = np.stack(made, axis=1)
    trainings = rng.integers(len(seeds), size=(DRAWS, len(seeds)))
    medians = _median(np.take_along_axis(of_seed[1:], trainings, axis=1))
    known = medians[~np.isnan(medians)]
    low, high = np.quantile(known, _ENDS, method="inverted_cdf") if len(known) else [np.nan] * 2
    each = tuple(float(value) for value in of_seed[0] if not math.isnan(value))
    value = float(_median(of_seed[:1])[0])
    command = next((one.command for one in samples if one.command), "")
    return Estimate(value, float(low), float(high), each, unit, command, len(seeds))


def _median(values: np.ndarray) -> np.ndarray:
    """Of the known values along the last axis; NaN without any."""
    with warnings.catch_warnings(action="ignore"):  # of a row without any
        return np.asarray(np.nanmedian(values, axis=-1))
