"""Tests of the paper's seven claims about models, each on one task after another."""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from contactgraph.cli.task_types import TestCondition
from contactgraph.viz.metric_table import short, with_unit
from contactgraph_studies.paper import jobs, statements
from contactgraph_studies.paper.config import (
    FAULTS,
    FULL_AB,
    GIM_NON_TEMP,
    GIM_TEMP,
    LITERAL,
    LITERAL_NO_GIM,
    NO_GIM,
    NO_GIM_AUG,
    NO_KL,
    Amounts,
    StudyModel,
    StudyTask,
)
from contactgraph_studies.paper.jobs import Source, condition_of, planned, recorded
from contactgraph_studies.results import (
    SUCCESS_PERCENT,
    Quantity,
    Results,
    SeedStatistic,
    Values,
    joined,
)
from contactgraph_studies.study import Claim

_FALSE_ALARMS = Quantity("edge_false_alarm_rate", "%", 100.0)
_PRECISION = Quantity("edge_precision", "%", 100.0)
_GROWTH = {
    "growth under the expert's control": Quantity("growth_driven", "times", null=math.inf),
    "growth without control": Quantity("growth_free", "times", null=math.inf),
    "spectral radius of A, first step": Quantity("spectral_radius", null=math.inf),
    "spectral radius of A, largest": Quantity("spectral_radius_max", null=math.inf),
}


def claims(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> list[Claim]:
    """Claims 1 to 7; the third only if the error of a task is measured by training data."""
    made = []
    for number, (statement, judge) in enumerate(
        zip(statements.STATEMENTS, _JUDGES, strict=True), start=1
    ):
        about = [task for task in tasks if task.with_samples or judge is not _more_data]
        claim = Claim(number, *statement, results, [task.name for task in about])
        for task in about:
            judge(claim, task, amounts)
        if about:
            made.append(claim)
    return made


def _small_in_distribution(claim: Claim, task: StudyTask, amounts: Amounts) -> None:
    errors = []
    for model in (model for model in statements.COMPARED if model in task.models):
        condition = planned(task, model, task.as_trained)
        errors.append(claim.measure(model.name, condition, jobs.PLANNED_ERROR))
        claim.judge(errors[-1].median < statements.SMALL_CM, errors[-1:])
    if largest := _medians(errors):
        claim.findings.append(f"{task.name}: the largest error is {with_unit(largest[-1], 'cm')}")


def _generalisation(claim: Claim, task: StudyTask, amounts: Amounts) -> None:
    growth, literal = {}, []
    for model in (NO_GIM, GIM_TEMP, LITERAL_NO_GIM, LITERAL):
        name = f"{model.name}, {task.hardest.name}"
        ratio = f"{name} over {task.as_trained.name}"
        growth[model] = _growth(claim.results, task, model, Source.planned, jobs.PLANNED_ERROR)
        open_loop = _growth(claim.results, task, model, Source.recorded, jobs.RECORDED_ERROR)
        claim.add(ratio, task.name, growth[model])
        claim.add(f"{ratio}, open loop", task.name, open_loop)
        claim.measure(name, planned(task, model, task.hardest), jobs.PLANNED_ERROR)
        if model in (LITERAL_NO_GIM, LITERAL) and open_loop.known:
            literal.append(f"{model.name} {_times(open_loop.median)}")
    sharp, slight = growth[NO_GIM].median, growth[GIM_TEMP].median
    own_form = f" (in the paper's own form, open loop: {joined(literal)})" if literal else ""
    claim.judge(
        sharp >= statements.SHARP and slight <= statements.SLIGHT,
        (growth[NO_GIM], growth[GIM_TEMP]),
        f"{task.name}: No-GIM's error is {_times(sharp)} that in distribution, "
        f"GIM-Temp's {_times(slight)}{own_form}",
    )


def _growth(
    results: Results, task: StudyTask, model: StudyModel, source: Source, error: Quantity
) -> SeedStatistic:
    """Error in the hardest scenes over that in distribution, seed by seed."""
    inside, outside = (
        results.statistic(condition_of(source, task, model, scenes), error)
        for scenes in (task.as_trained, task.hardest)
    )
    if len(inside.values) != len(outside.values):
        return SeedStatistic(unit="times")
    pairs = zip(inside.values, outside.values, strict=True)
    ratios = [math.inf if math.isinf(far) else far / near for near, far in pairs if near > 0.0]
    return SeedStatistic(tuple(ratios), outside.command, "times")


def sample_errors(
    results: Results, task: StudyTask, model: StudyModel, scenes: TestCondition, runs: int
) -> SeedStatistic:
    """Open-loop error of a model trained on this number of trajectories, cm."""
    condition = condition_of(Source.samples, task, model, scenes, training_runs=runs)
    return results.statistic(condition, jobs.RECORDED_ERROR)


def _more_data(claim: Claim, task: StudyTask, amounts: Amounts) -> None:
    sizes, few, scenes = amounts.sample_sizes, task.training_runs, task.hardest
    own = sample_errors(claim.results, task, GIM_TEMP, scenes, few)
    curve = [sample_errors(claim.results, task, NO_GIM_AUG, scenes, size) for size in sizes]
    claim.add(f"GIM-Temp, {few} runs", task.name, own)
    claim.add(f"No-GIM-Aug, {sizes[-1]} runs", task.name, curve[-1])
    ratios = [
        data_ratio(sizes, [one.values[seed] for one in curve], few, own.values[seed])
        for seed in range(min(len(one.values) for one in (own, *curve)))
    ]
    known = tuple(ratio for ratio in ratios if ratio is not None)
    needed = SeedStatistic(known, curve[-1].command, "times")
    reached = math.isfinite(needed.median)
    if needed.known:
        claim.add("data needed for equal error", task.name, needed)
    claim.judge(
        reached and needed.median >= statements.MORE_DATA,
        [needed],
        f"{task.name}: No-GIM-Aug needs {short(needed.median)} times the data"
        if reached
        else f"{task.name}: not reached with {sizes[-1]}: No-GIM-Aug is at {curve[-1]} there, "
        f"GIM-Temp at {own} with {few}, so it needs more than {sizes[-1] / few:g} times the data",
    )


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


def _corrected_edges(claim: Claim, task: StudyTask, amounts: Amounts) -> None:
    scenes, accuracy = task.as_trained, jobs.EDGE_ACCURACY
    opened = recorded(task, GIM_TEMP, scenes)
    own, other = (
        claim.measure(
            f"{model.name}, edge accuracy", planned(task, model, scenes), jobs.PLANNED_ACCURACY
        )
        for model in (GIM_TEMP, GIM_NON_TEMP)
    )
    corrected = claim.measure("GIM-Temp, recorded, corrected", opened, accuracy)
    plain = claim.measure("GIM-Temp, recorded, not corrected", opened, jobs.UNMEASURED_ACCURACY)
    claim.measure("GIM-Non-Temp, recorded", recorded(task, GIM_NON_TEMP, scenes), accuracy)
    for fault in FAULTS:
        faulty = condition_of(Source.faults, task, GIM_TEMP, scenes, sensor=fault.name)
        claim.measure(f"GIM-Temp, recorded, sensor {fault.name}", faulty, accuracy)
    claim.judge(
        own.median > other.median and corrected.median > plain.median,
        (own, other, corrected, plain),
        f"{task.name}: {_percent(own.median)} against GIM-Non-Temp's {_percent(other.median)} "
        f"in closed loop; on recorded runs {_percent(corrected.median)} with correction, "
        f"{_percent(plain.median)} without",
    )


def _larger_growth(values: Values) -> float:
    growth = (values.get("growth_driven"), values.get("growth_free"))
    return max(math.inf if value is None else value for value in growth)


_LARGEST_GROWTH = Quantity("growth_free", derived=_larger_growth)


def _free_matrices(claim: Claim, task: StudyTask, amounts: Amounts) -> None:
    largest, success = {}, {}
    for model in (FULL_AB, GIM_TEMP):
        growth, near, far = (
            condition_of(source, task, model, task.as_trained)
            for source in (Source.growth, Source.planned, Source.long_plan)
        )
        for name, quantity in _GROWTH.items():
            claim.measure(f"{model.name}, {name}", growth, quantity)
        largest[model] = claim.results.statistic(growth, _LARGEST_GROWTH)
        success[model] = [
            claim.measure(f"{model.name}, success, planned a {name} ahead", one, SUCCESS_PERCENT)
            for one, name in ((near, "short way"), (far, "whole run"))
        ]
    grown, rates = largest[FULL_AB].median, [one.median for one in success[FULL_AB]]
    claim.judge(
        grown >= statements.UNBOUNDED and max(rates) < statements.INFEASIBLE,
        (largest[FULL_AB], *success[FULL_AB]),
        f"{task.name}: rolled out over a whole run its states grow "
        f"{'not finitely' if math.isinf(grown) else _times(grown)} "
        f"(GIM-Temp's {short(largest[GIM_TEMP].median)} times), and control succeeds in "
        f"{short(rates[0])} % of the episodes planned a short way ahead, "
        f"{short(rates[1])} % of those planned a whole run ahead",
    )


def _prior_needed(claim: Claim, task: StudyTask, amounts: Amounts) -> None:
    scenes = task.hardest
    name = "edges active of those without contact, without KL"
    stray = claim.measure(name, recorded(task, NO_KL, scenes), _FALSE_ALARMS)
    own, other = (
        claim.measure(f"{name}, {scenes.name}", planned(task, model, scenes), jobs.PLANNED_ERROR)
        for model, name in ((NO_KL, "without KL"), (NO_GIM, "No-GIM"))
    )
    as_bad = math.isinf(own.median) or own.median >= statements.AS_BAD * other.median
    claim.judge(
        stray.median >= statements.CONNECTED and as_bad,
        (stray, own, other),
        f"{task.name}: {_percent(stray.median)} of the edges without contact are active, and "
        f"with {scenes.name} the error is {own} against No-GIM's {other}",
    )


def _edges_mean_contact(claim: Claim, task: StudyTask, amounts: Amounts) -> None:
    strays, precisions = [], []
    for model in (GIM_TEMP, GIM_NON_TEMP):
        for scenes in (task.as_trained, task.hardest):
            condition, name = recorded(task, model, scenes), f"{model.name}, {scenes.name}"
            stray = claim.measure(f"{name}, active without contact", condition, _FALSE_ALARMS)
            precision = claim.measure(f"{name}, precision", condition, _PRECISION)
            claim.judge(
                stray.median <= statements.STRAY and precision.median >= statements.PRECISE,
                (stray, precision),
            )
            strays.append(stray)
            precisions.append(precision)
    if (active := _medians(strays)) and (precise := _medians(precisions)):
        claim.findings.append(
            f"{task.name}: at most {_percent(active[-1])} of the edges without contact are active, "
            f"and at least {_percent(precise[0])} of the active ones are in contact"
        )


def _medians(measured: Iterable[SeedStatistic]) -> list[float]:
    """The known ones, in ascending order."""
    return sorted(one.median for one in measured if one.known)


def _times(ratio: float) -> str:
    return "not finite against" if math.isinf(ratio) else f"{short(ratio)} times"


def _percent(value: float) -> str:
    """With as many digits as it takes to tell it from 100 % and from 0."""
    distance = min(value, 100.0 - value)
    if not distance > 0.0:
        return f"{value:g} %"
    return f"{value:.{max(1, 1 - math.floor(math.log10(distance)))}f} %"


_JUDGES: tuple[Callable[[Claim, StudyTask, Amounts], None], ...] = (
    _small_in_distribution,
    _generalisation,
    _more_data,
    _corrected_edges,
    _free_matrices,
    _prior_needed,
    _edges_mean_contact,
)
"""For each of `statements.STATEMENTS`: adds a task's numbers, verdicts and finding to the claim."""
