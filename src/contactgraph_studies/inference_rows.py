"""Requirements of inference: one row for each number that is asked for, task by task."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from contactgraph.cli.task_types import Target
from contactgraph.viz import ReportMetric
from contactgraph_studies.inference_jobs import (
    COMMANDED,
    CONTROLLED,
    EXACT,
    FILTER,
    FIRST_FORM,
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
from contactgraph_studies.study import judged
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

_SHARES = {
    "suction-hidden": {INFERRED: Target(0.95, 0.85), MEASURED: Target(0.93, 0.85)},
    "release": {INFERRED: Target(0.82, 0.65), MEASURED: Target(0.80, 0.65)},
    "delay": dict.fromkeys(SOURCES, Target(0.20, 0.05)),
    "sticky": dict.fromkeys(SOURCES, Target(0.95, 0.85)),
}
_F1_TARGETS = {INFERRED: Target(0.98, 0.995), MEASURED: Target(0.999, 1.0)}
_CALIBRATION_TARGETS = {"one step ahead": Target(0.02, 0.01), "ten steps ahead": Target(0.08, 0.03)}
_FAULTS = {LYING: Target(1.1, 1.02), LATE: Target(1.5, 1.1)}


@dataclass(frozen=True)
class Requirement:
    """A number that is asked for."""

    what: str
    task: str
    statistic: SeedStatistic
    target: Target
    conditions: tuple[InferenceCondition, ...]
    """The measurements behind it."""
    lower: bool = True
    """Whether lower is better."""
    every: bool = False
    """Whether each value must reach the target, not only their median."""

    def metric(self, seeds: Sequence[int]) -> ReportMetric:
        """The same for the page."""
        name = f"{self.what}: {self.task}"
        return judged(name, self.statistic, self.target, seeds, self.lower, self.every)


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


def requirements(results: Results, tasks: Mapping[str, str]) -> list[Requirement]:
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


def _told_free(numbers: InferenceNumbers, tasks: Mapping[str, str]) -> Iterator[Requirement]:
    asked = {
        "told free ten times while touching, belief in contact: next step": (
            TOLD_FREE,
            Target(0.05, 0.01),
        ),
        "the same 0.5 s later, nothing more measured": (TOLD_FREE_LATER, Target(0.1)),
    }
    trained = tuple(slug for slug in tasks if slug in (*HIDDEN, COMMANDED, *KNOWN))
    shipped = tuple(slug for slug in tasks if slug not in (*HIDDEN, COMMANDED))
    groups = {"shipped models": (SHIPPED, shipped), "all trainings": (FILTER, trained)}
    for what, (quantity, target) in asked.items():
        for group, (model, slugs) in groups.items():
            if not slugs:
                continue
            found = [numbers.statistic(slug, quantity, model=model) for slug in slugs]
            where = tuple(_where(slug, EXACT, model) for slug in slugs)
            yield Requirement(what, group, _pooled(found), target, where, every=True)


def _errors(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[Requirement]:
    where = (_where(slug, EXACT),)
    for source, words in SOURCES.items():
        if slug in HIDDEN:
            share = numbers.share(slug, ERRORS[source], FLOOR)
            what, target = f"error over the floor, {words}", _SHARES[slug][source]
            yield Requirement(what, task, share, target, where)
        elif slug == COMMANDED:
            error = numbers.statistic(slug, ERRORS[source])
            yield Requirement(f"error, {words}", task, error, Target(0.3, 0.05), where)


def _edges(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[Requirement]:
    for source, words in SOURCES.items() if slug in HIDDEN else ():
        f1, target = numbers.statistic(slug, F1[source]), _F1_TARGETS[source]
        what = f"edge F1 of the step just made, {words}"
        yield Requirement(what, task, f1, target, (_where(slug, EXACT),), lower=False)


def _priors(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[Requirement]:
    where = tuple(_where(slug, one) for one in PRIORS)
    for source, words in SOURCES.items() if slug in HIDDEN else ():
        growth = numbers.least_share(slug, ERRORS[source], ERRORS[source], PRIORS)
        what = f"inference replaced by the geometric prior, error over the filter's, {words}"
        yield Requirement(what, task, growth, Target(1.3, 2.0), where, lower=False)


def _calibrations(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[Requirement]:
    for when, quantity in CALIBRATION.items() if slug in (*HIDDEN, COMMANDED, *KNOWN) else ():
        what, target = f"expected calibration error, {when}", _CALIBRATION_TARGETS[when]
        found = numbers.statistic(slug, quantity)
        yield Requirement(what, task, found, target, (_where(slug, EXACT),))


def _faults(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[Requirement]:
    error = ERRORS[MEASURED]
    for variant, target in _FAULTS.items() if slug in HIDDEN else ():
        growth = numbers.share(slug, error, error, variant)
        what = f"{variant.name}: error over that of an exact sensor"
        yield Requirement(what, task, growth, target, (_where(slug, variant),), every=True)


def _known(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[Requirement]:
    if slug not in KNOWN:
        return
    first = numbers.statistic(slug, ERRORS[MEASURED], model=FIRST_FORM)
    target = Target(round(first.high, 4) if first.known else 0.5, 0.2)
    error = numbers.statistic(slug, ERRORS[MEASURED])
    both = (_where(slug, EXACT), _where(slug, EXACT, FIRST_FORM))
    what = "error, contacts measured (at least: the first form's, worst training)"
    yield Requirement(what, task, error, target, both)
    success = numbers.statistic(slug, SUCCESS_PERCENT, CONTROLLED)
    where = (_where(slug, CONTROLLED),)
    yield Requirement("success", task, success, Target(98.0, 100.0), where, lower=False)


def _closed(numbers: InferenceNumbers, slug: str, task: str) -> Iterator[Requirement]:
    if slug == COMMANDED:
        success = numbers.statistic(slug, SUCCESS_PERCENT, LOSING)
        where, target = (_where(slug, LOSING),), Target(95.0, 100.0)
        yield Requirement("success, half of the grasps lost", task, success, target, where, False)
    if slug == "pickup":
        step = numbers.statistic(slug, PLAN_MS, TEN_DISTRACTORS)
        where, target = (_where(slug, TEN_DISTRACTORS),), Target(3.0, 2.0)
        what = "control step corrected by motion, 11 objects"
        yield Requirement(what, task, step, target, where)


def _training(numbers: InferenceNumbers, tasks: Mapping[str, str]) -> Iterator[Requirement]:
    slugs = [slug for slug in tasks if slug in (*HIDDEN, COMMANDED, *KNOWN)]
    found = _pooled([numbers.statistic(slug, TRAINING_S) for slug in slugs])
    where = tuple(_where(slug, EXACT) for slug in slugs)
    what = "training, 60 trajectories, on one core beside another job"
    yield Requirement(what, "all trainings", found, Target(120.0, 45.0), where, every=True)
