"""Tests of the paper's seven claims about models, on each task for each family of models."""

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from contactgraph.envs.registry import TestCondition
from contactgraph_studies.bootstrap import Estimate, Sample, Verdict, all_hold, estimate, mean
from contactgraph_studies.paper import jobs, statements
from contactgraph_studies.paper.config import (
    Amounts,
    Family,
    StudyModel,
    StudyTask,
    families_of,
)
from contactgraph_studies.paper.jobs import Source, closed_error, condition_of, open_error
from contactgraph_studies.results import SLOWEST_MS, Quantity, Results, Values
from contactgraph_studies.study import Claim

_FALSE_ALARMS = Quantity("edge_false_alarm_rate", "%", 100.0)
_PRECISION = Quantity("edge_precision", "%", 100.0)


def claims(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> list[Claim]:
    """Claims 1 to 7, each for one family after another."""
    found = (
        _claim(results, number, family, tasks, amounts)
        for number in range(1, len(_JUDGES) + 1)
        for family in families_of(tasks)
    )
    return [claim for claim in found if claim is not None]


def _claim(
    results: Results, number: int, family: Family, tasks: Sequence[StudyTask], amounts: Amounts
) -> Claim | None:
    """None: no task measures what it is about."""
    asked, judge = _JUDGES[number - 1]
    about = [task for task in tasks if asked(task, family)]
    statement = statements.STATEMENTS[number - 1]
    claim = Claim(number, *statement, results, [task.name for task in about], family.name)
    for task in about:
        evidence = _Evidence(claim, task, family, amounts)
        claim.verdicts.append(all_hold(list(judge(evidence))))
        if evidence.findings:
            claim.findings.append(f"{task.name}: {', '.join(evidence.findings)}")
    return claim if about else None


class _Evidence:
    """The numbers of one family on one task, which are recorded as they are read."""

    def __init__(self, claim: Claim, task: StudyTask, family: Family, amounts: Amounts) -> None:
        self.task, self.family, self.amounts = task, family, amounts
        self._claim, self._results = claim, claim.results
        self.findings: list[str] = []

    def add(
        self,
        name: str,
        samples: Sequence[Sample],
        statistic: Callable[..., np.ndarray] | None = None,
        unit: str = "",
        finding: bool = False,
    ) -> Estimate:
        """A number with its interval; a ``finding`` is told in the claim's sentence."""
        found = self._claim.estimated(name, self.task.name, estimate(samples, statistic, unit))
        if finding and found.trainings:
            self.findings.append(f"{name} {found}")
        return found

    def closed(self, model: StudyModel, scenes: TestCondition) -> Sample:
        """See `closed_error`."""
        return closed_error(self._results, self.task, model, scenes)

    def success(
        self, model: StudyModel, source: Source, scenes: TestCondition | None = None
    ) -> Sample:
        """In distribution, or in other scenes."""
        condition = condition_of(source, self.task, model, scenes or self.task.as_trained)
        return self._results.scene_sample(condition, jobs.SUCCESS_BY_EPISODE, mean)

    def opened(self, model: StudyModel, runs: int) -> Sample:
        """Out of distribution, by number of training trajectories."""
        return open_error(self._results, self.task, model, runs)

    def number(
        self, model: StudyModel, scenes: TestCondition, quantity: Quantity, source: Source
    ) -> Sample:
        """One number of each training."""
        return self._results.sample(condition_of(source, self.task, model, scenes), quantity)


def _small_in_distribution(of: _Evidence) -> Iterator[Verdict]:
    scenes = of.task.as_trained
    models = [model for model in of.family.compared if model in of.task.models]
    errors = [of.closed(model, scenes) for model in models]
    for model, error in zip(models, errors, strict=True):
        of.add(model.kind, [error])
        # A controller that moves nothing makes no error.
        of.add(f"{model.kind}, success", [of.success(model, Source.planned)])
    worst = of.add(
        "the largest error is", errors, lambda *each: np.maximum.reduce(each), "cm", finding=True
    )
    yield worst.below(statements.SMALL_CM)


def _generalisation(of: _Evidence) -> Iterator[Verdict]:
    grown = {}
    for model in (of.family.no_gim, of.family.gim_temp):
        near, far = (of.closed(model, each) for each in (of.task.as_trained, of.task.hardest))
        of.add(f"{model.kind}, {of.task.as_trained.name}", [near])
        of.add(f"{model.kind}, {of.task.hardest.name}", [far])
        # A controller that moves nothing makes no error.
        reached = of.success(model, Source.planned, of.task.hardest)
        of.add(f"{model.kind}'s success out of distribution is", [reached], finding=True)
        name = f"{model.kind}'s error out of distribution is that in distribution times"
        grown[model] = of.add(name, [far, near], _ratio, finding=True)
    yield grown[of.family.no_gim].within(statements.SHARP, math.inf)
    yield grown[of.family.gim_temp].within(-math.inf, statements.SLIGHT)


def _more_data(of: _Evidence) -> Iterator[Verdict]:
    sizes, few = of.amounts.sample_sizes, of.task.training_runs
    own = of.opened(of.family.gim_temp, few)
    curve = [of.opened(of.family.no_gim_aug, size) for size in sizes]
    of.add(f"GIM-Temp, {few} trajectories", [own])
    for size, one in zip(sizes, curve, strict=True):
        of.add(f"No-GIM-Aug, {size} trajectories", [one])

    def needed(reference: float, *errors: float) -> float:
        ratio = data_ratio(sizes, errors, few, reference)
        return math.nan if ratio is None else ratio

    name = "for GIM-Temp's error No-GIM-Aug needs its number of trajectories times"
    found = of.add(name, [own, *curve], np.vectorize(needed, otypes=[float]), finding=True)
    yield found.within(statements.MORE_DATA, statements.MOST_DATA)


def data_ratio(
    sizes: Sequence[int], errors: Sequence[float], reference_runs: int, reference_error: float
) -> float | None:
    """Trajectories needed to reach ``reference_error``, over ``reference_runs``.

    ``errors`` belong to models trained on ``sizes`` trajectories, in ascending order, and are
    interpolated linearly in log-log; the first crossing counts. An error that the smallest size
    already has gives an upper bound of the ratio. Infinity: never reached. None: not known.
    """
    pairs = zip(sizes, errors, strict=True)
    known = [(size, error) for size, error in pairs if not math.isnan(error) and error > 0.0]
    if not known or not reference_error > 0.0 or math.isinf(reference_error):
        return None
    previous_size, previous = 0, math.inf
    for size, error in known:
        if error <= reference_error:
            if math.isinf(previous):
                return size / reference_runs
            logs = np.log([error, previous]), np.log([size, previous_size])
            return math.exp(np.interp(np.log(reference_error), *logs)) / reference_runs
        previous_size, previous = size, error
    return math.inf


def _corrected_edges(of: _Evidence) -> Iterator[Verdict]:
    scenes = of.task.as_trained
    own, other = (
        of.number(model, scenes, jobs.PLANNED_ACCURACY, Source.planned)
        for model in (of.family.gim_temp, of.family.gim_non_temp)
    )
    corrected, plain = (
        of.number(of.family.gim_temp, scenes, quantity, Source.recorded)
        for quantity in (jobs.EDGE_ACCURACY, jobs.UNMEASURED_ACCURACY)
    )
    of.add("GIM-Temp, edge accuracy", [own])
    of.add("GIM-Non-Temp, edge accuracy", [other])
    of.add("GIM-Temp, recorded, corrected", [corrected])
    of.add("GIM-Temp, recorded, not corrected", [plain])
    name = "edge accuracy less GIM-Non-Temp's"
    yield of.add(name, [own, other], np.subtract, "points", finding=True).above(0.0)
    name = "gain by correction"
    yield of.add(name, [corrected, plain], np.subtract, "points", finding=True).above(0.0)


def _larger_growth(values: Values) -> float:
    growth = (values.get("growth_driven"), values.get("growth_free"))
    return max(math.inf if value is None else value for value in growth)


_LARGEST_GROWTH = Quantity("growth_free", "times", derived=_larger_growth)


def _free_matrices(of: _Evidence) -> Iterator[Verdict]:
    scenes, grown, success = of.task.as_trained, {}, {}
    for model in (of.family.full_ab, of.family.gim_temp):
        growth = of.number(model, scenes, _LARGEST_GROWTH, Source.growth)
        grown[model] = of.add(f"{model.kind}'s states grow", [growth], finding=True)
        for source, ahead in ((Source.planned, "0.5 s"), (Source.long_plan, "a whole episode")):
            name = f"{model.kind} planned {ahead} ahead succeeds in"
            success[model, source] = of.add(name, [of.success(model, source)], finding=True)
        # Of 50 control steps one plans.
        time = of.number(model, scenes, SLOWEST_MS, Source.long_plan)
        of.add(f"a plan of {model.kind} that far takes", [time], finding=True)
    full = of.family.full_ab
    yield grown[full].within(statements.UNBOUNDED, math.inf)
    yield success[full, Source.planned].below(statements.INFEASIBLE)
    yield success[full, Source.long_plan].below(statements.INFEASIBLE)


def _prior_needed(of: _Evidence) -> Iterator[Verdict]:
    scenes, no_kl = of.task.hardest, of.family.no_kl
    active = of.number(no_kl, scenes, _FALSE_ALARMS, Source.recorded)
    stray = of.add("edges active of those without contact", [active], finding=True)
    own, other = of.closed(no_kl, scenes), of.closed(of.family.no_gim, scenes)
    of.add("without KL", [own])
    of.add("No-GIM", [other])
    ratio = of.add("the error is No-GIM's times", [own, other], _ratio, finding=True)
    yield stray.within(statements.CONNECTED, math.inf)
    yield ratio.within(statements.AS_BAD, math.inf)


def _edges_mean_contact(of: _Evidence) -> Iterator[Verdict]:
    for model in (of.family.gim_temp, of.family.gim_non_temp):
        for scenes in (of.task.as_trained, of.task.hardest):
            name = f"{model.kind}, {scenes.name}"
            stray, precision = (
                of.number(model, scenes, quantity, Source.recorded)
                for quantity in (_FALSE_ALARMS, _PRECISION)
            )
            active = of.add(f"{name}, active without contact", [stray], finding=True)
            precise = of.add(f"{name}, precision", [precision], finding=True)
            yield active.within(-math.inf, statements.STRAY)
            yield precise.within(statements.PRECISE, math.inf)


def _ratio(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Infinite over infinite is infinite."""
    return np.where(np.isinf(above), above, above / below)


def _measured(task: StudyTask, family: Family) -> bool:
    return family in task.families


def _sampled(task: StudyTask, family: Family) -> bool:
    return _measured(task, family) and task.with_samples


def _whole(task: StudyTask, family: Family) -> bool:
    return set(family.models) <= set(task.models)


_JUDGES: tuple[
    tuple[Callable[[StudyTask, Family], bool], Callable[[_Evidence], Iterator[Verdict]]], ...
] = (
    (_measured, _small_in_distribution),
    (_measured, _generalisation),
    (_sampled, _more_data),
    (_measured, _corrected_edges),
    (_whole, _free_matrices),
    (_whole, _prior_needed),
    (_measured, _edges_mean_contact),
)
"""For each of `statements.STATEMENTS`: whether a task tells it of a family, and the verdicts on
what it asks, all of which must hold."""
