"""Numbers of inference: one row for each, task by task."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from contactgraph_studies.inference_jobs import (
    COMMANDED,
    CONTROLLED,
    EXACT,
    FILTER,
    HIDDEN,
    KNOWN,
    LATE,
    LOSING,
    LYING,
    PRIORS,
    SHIPPED,
    TEN_DISTRACTORS,
    InferenceCondition,
)
from contactgraph_studies.job import Variant
from contactgraph_studies.results import PLAN_MS, SUCCESS_PERCENT, Quantity, Results, SeedStatistic
from contactgraph_studies.world_row import ERRORS, INFERRED, MEASURED

TOLD_FREE = Quantity("told_free_belief")
TOLD_FREE_LATER = Quantity("told_free_belief_later")
TRAINING_S = Quantity("training_s", "s")
FLOOR = ERRORS["frozen_contact_cm"]
F1 = {INFERRED: Quantity("edge_f1_now_inferred"), MEASURED: Quantity("edge_f1_now")}
CALIBRATION = {
    "one step ahead": Quantity("calibration_error_inferred"),
    "ten steps ahead": Quantity("calibration_error_ahead_inferred"),
}
SOURCES = {INFERRED: "by motion alone", MEASURED: "contacts measured"}


@dataclass(frozen=True)
class InferenceRow:
    """One measured number."""

    what: str
    task: str
    statistic: SeedStatistic
    conditions: tuple[InferenceCondition, ...]
    """The measurements behind it."""


@dataclass(frozen=True)
class InferenceNumbers:
    """Readings of the study, combined seed by seed."""

    results: Results

    def statistic(
        self, task: str, quantity: Quantity, variant: Variant = EXACT, model: Variant = FILTER
    ) -> SeedStatistic:
        """Of all trainings of a task."""
        return self.results.statistic(_where(task, variant, model), quantity)

    def share(
        self, task: str, over: Quantity, under: Quantity, variant: Variant = EXACT
    ) -> SeedStatistic:
        """``over`` under a variant, divided by ``under`` with an exact sensor."""
        return self.least_share(task, over, under, (variant,))

    def least_share(
        self, task: str, over: Quantity, under: Quantity, variants: Sequence[Variant]
    ) -> SeedStatistic:
        """The same of the variant with the smallest number; without those that lack any."""
        here = partial(_where, task)
        each = [self.results.by_seed(here(one), over) for one in variants]
        below = self.results.by_seed(here(EXACT), under)
        seeds = [
            seed
            for seed in below
            if 0 < below[seed] < math.inf and all(seed in one for one in each)
        ]
        values = tuple(min(one[seed] for one in each) / below[seed] for seed in seeds)
        return SeedStatistic(values, self.results.command(here(variants[0]), over))


def _where(task: str, variant: Variant, model: Variant = FILTER) -> InferenceCondition:
    return InferenceCondition(task, model.name, variant.name)


def inference_rows(results: Results, tasks: Mapping[str, str]) -> list[InferenceRow]:
    """All rows; ``tasks`` are names by slug, of those that are shown."""
    numbers = InferenceNumbers(results)
    rows = [*_told_free(numbers, tasks)]
    for rule in (_errors, _edges, _priors, _calibrations, _faults, _known, _closed):
        rows += [row for slug in tasks for row in rule(numbers, slug, tasks[slug])]
    return [*rows, *_training(numbers, tasks)]


def _pooled(statistics: Sequence[SeedStatistic]) -> SeedStatistic:
    """The values of all of them."""
    known = [one for one in statistics if one.known]
    values = tuple(value for one in known for value in one.values)
    return SeedStatistic(values, known[0].command, known[0].unit) if known else SeedStatistic()


def _told_free(numbers: InferenceNumbers, tasks: Mapping[str, str]) -> Iterator[InferenceRow]:
    quantities = {
        "told free ten times while touching, belief in contact: next step": TOLD_FREE,
        "the same 0.5 s later, nothing more measured": TOLD_FREE_LATER,
    }
    trained = tuple(slug for slug in tasks if slug in (*HIDDEN, COMMANDED, *KNOWN))
    shipped = tuple(slug for slug in tasks if slug not in (*HIDDEN, COMMANDED))
    groups = {"shipped models": (SHIPPED, shipped), "all trainings": (FILTER, trained)}
    for what, quantity in quantities.items():
        for group, (model, slugs) in groups.items():
            if not slugs:
                continue
            found = [numbers.statistic(slug, quantity, model=model) for slug in slugs]
            where = tuple(_where(slug, EXACT, model) for slug in slugs)
            yield InferenceRow(what, group, _pooled(found), where)


def _errors(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[InferenceRow]:
    where = (_where(slug, EXACT),)
    for source, words in SOURCES.items():
        if slug in HIDDEN:
            share = numbers.share(slug, ERRORS[source], FLOOR)
            yield InferenceRow(f"error over the floor, {words}", task, share, where)
        elif slug == COMMANDED:
            error = numbers.statistic(slug, ERRORS[source])
            yield InferenceRow(f"error, {words}", task, error, where)


def _edges(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[InferenceRow]:
    for source, words in SOURCES.items() if slug in HIDDEN else ():
        f1 = numbers.statistic(slug, F1[source])
        what = f"edge F1 of the step just made, {words}"
        yield InferenceRow(what, task, f1, (_where(slug, EXACT),))


def _priors(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[InferenceRow]:
    where = tuple(_where(slug, one) for one in PRIORS)
    for source, words in SOURCES.items() if slug in HIDDEN else ():
        growth = numbers.least_share(slug, ERRORS[source], ERRORS[source], PRIORS)
        what = f"inference replaced by the geometric prior, error over the filter's, {words}"
        yield InferenceRow(what, task, growth, where)


def _calibrations(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[InferenceRow]:
    for when, quantity in CALIBRATION.items() if slug in (*HIDDEN, COMMANDED, *KNOWN) else ():
        found = numbers.statistic(slug, quantity)
        what = f"expected calibration error, {when}"
        yield InferenceRow(what, task, found, (_where(slug, EXACT),))


def _faults(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[InferenceRow]:
    error = ERRORS[MEASURED]
    for variant in (LYING, LATE) if slug in HIDDEN else ():
        growth = numbers.share(slug, error, error, variant)
        what = f"{variant.name}: error over that of an exact sensor"
        yield InferenceRow(what, task, growth, (_where(slug, variant),))


def _known(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[InferenceRow]:
    if slug not in KNOWN:
        return
    error = numbers.statistic(slug, ERRORS[MEASURED])
    yield InferenceRow("error, contacts measured", task, error, (_where(slug, EXACT),))
    success = numbers.statistic(slug, SUCCESS_PERCENT, CONTROLLED)
    yield InferenceRow("success", task, success, (_where(slug, CONTROLLED),))


def _closed(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[InferenceRow]:
    if slug == COMMANDED:
        success = numbers.statistic(slug, SUCCESS_PERCENT, LOSING)
        where = (_where(slug, LOSING),)
        yield InferenceRow("success, half of the grasps lost", task, success, where)
    if slug == "pickup":
        step = numbers.statistic(slug, PLAN_MS, TEN_DISTRACTORS)
        where = (_where(slug, TEN_DISTRACTORS),)
        yield InferenceRow("control step corrected by motion, 11 objects", task, step, where)


def _training(numbers: InferenceNumbers, tasks: Mapping[str, str]) -> Iterator[InferenceRow]:
    slugs = [slug for slug in tasks if slug in (*HIDDEN, COMMANDED, *KNOWN)]
    found = _pooled([numbers.statistic(slug, TRAINING_S) for slug in slugs])
    where = tuple(_where(slug, EXACT) for slug in slugs)
    what = "training, 60 trajectories, on one core beside another job"
    yield InferenceRow(what, "all trainings", found, where)
