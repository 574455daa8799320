"""The paper's claims about prediction errors (1 to 3), and the list of all seven."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from contactgraph.cli.tasks import TestCondition
from contactgraph.viz.metric_table import short, with_unit
from contactgraph_studies.paper.claims_graph import (
    corrected_edges,
    edges_mean_contact,
    free_matrices,
    prior_needed,
)
from contactgraph_studies.paper.config import (
    GIM_NON_TEMP,
    GIM_TEMP,
    LITERAL,
    LITERAL_NO_GIM,
    NO_GIM,
    NO_GIM_AUG,
    Amounts,
    StudyModel,
    StudyTask,
)
from contactgraph_studies.paper.jobs import (
    PLANNED_ERROR,
    RECORDED_ERROR,
    ModelCondition,
    Source,
    planned,
    recorded,
)
from contactgraph_studies.results import Quantity, Results, SeedStatistic, joined
from contactgraph_studies.study import Claim

_SMALL_CM = 1.0
"""The paper's "less than a centimeter"."""
_SHARP, _SLIGHT = 2.0, 1.5
"""Growth of an error from which on it is sharp, and up to which it is slight."""
_MORE_DATA = 3.0
"""The lower end of the paper's "three to four times more data"."""
_COMPARED = (GIM_TEMP, GIM_NON_TEMP, NO_GIM, NO_GIM_AUG)
"""The models in the paper's figure of errors. Full-AB is missing: control cannot use it."""


def claims(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> list[Claim]:
    """Claims 1 to 7; the third only if the error of a task is measured by training data."""
    sampled = [task for task in tasks if task.with_samples]
    return [
        _small_in_distribution(results, tasks),
        _generalisation(results, tasks),
        *([_more_data(results, sampled, amounts)] if sampled else []),
        corrected_edges(results, tasks),
        free_matrices(results, tasks),
        prior_needed(results, tasks),
        edges_mean_contact(results, tasks),
    ]


def _small_in_distribution(results: Results, tasks: Sequence[StudyTask]) -> Claim:
    """Claim 1."""
    claim = Claim(
        1,
        "In distribution, every model's N-step error is under 1 cm",
        "when tested with the same number of object interactions as seen during training, "
        "the N-step prediction error for all the models trained using simulation data is less "
        "than a centimeter",
        f"the median over seeds is below {_SMALL_CM:g} cm for "
        f"{joined([model.name for model in _COMPARED])} on every task",
        results,
        [task.name for task in tasks],
    )
    large = []
    for task in tasks:
        for model in (model for model in _COMPARED if model in task.models):
            condition = planned(task, model, task.as_trained)
            error = claim.measure(model.name, task.name, "cm", condition, PLANNED_ERROR)
            claim.judge(error.median < _SMALL_CM, [error])
            if error.median >= _SMALL_CM:
                large.append(f"{model.name} on {task.name} ({with_unit(error.median, 'cm')})")
    known = [one.statistic.median for one in claim.metrics if one.statistic.known]
    worst = with_unit(max(known, default=math.nan), "cm")
    claim.sentence = {
        True: f"The largest median error of any of these models is {worst}.",
        False: f"1 cm or more: {joined(large)}.",
        None: "Not every model was measured.",
    }[claim.holds]
    return claim


def _generalisation(results: Results, tasks: Sequence[StudyTask]) -> Claim:
    """Claim 2."""
    claim = Claim(
        2,
        "With more objects or interactions No-GIM's error grows sharply, GIM-Temp's does not",
        "when tested for generalization, the performance of No-GIM deteriorates "
        "significantly across all the tasks",
        f"on every task No-GIM's error (all nodes) is at least {_SHARP:g} times that in "
        f"distribution, and GIM-Temp's at most {_SLIGHT:g} times",
        results,
        [task.name for task in tasks],
    )
    literal = []
    for task in tasks:
        growth = {}
        for model in (NO_GIM, GIM_TEMP, LITERAL_NO_GIM, LITERAL):
            name = f"{model.name}, {task.hardest.name}"
            ratio = f"{name} over {task.as_trained.name}"
            growth[model] = _growth(results, task, model, planned, PLANNED_ERROR)
            open_loop = _growth(results, task, model, recorded, RECORDED_ERROR)
            claim.add(ratio, task.name, "times", growth[model])
            claim.add(f"{ratio}, open loop", task.name, "times", open_loop)
            condition = planned(task, model, task.hardest)
            claim.measure(name, task.name, "cm", condition, PLANNED_ERROR)
            if model in (LITERAL_NO_GIM, LITERAL) and open_loop.known:
                literal.append(f"{task.name}, {model.name} {_times(open_loop.median)}")
        sharp, slight = growth[NO_GIM].median, growth[GIM_TEMP].median
        claim.judge(
            sharp >= _SHARP and slight <= _SLIGHT,
            (growth[NO_GIM], growth[GIM_TEMP]),
            f"{task.name}: No-GIM's error is {_times(sharp)} that in distribution, "
            f"GIM-Temp's {_times(slight)}",
        )
    if literal:
        claim.findings.append(f"in the paper's own form, open loop: {', '.join(literal)}")
        claim.sentence = f"{'; '.join(claim.findings)}."
    return claim


def _growth(
    results: Results,
    task: StudyTask,
    model: StudyModel,
    condition_of: Callable[[StudyTask, StudyModel, TestCondition], ModelCondition],
    error: Quantity,
) -> SeedStatistic:
    """Error in the hardest scenes over that in distribution, seed by seed."""
    inside = results.statistic(condition_of(task, model, task.as_trained), error)
    outside = results.statistic(condition_of(task, model, task.hardest), error)
    if len(inside.values) != len(outside.values):
        return SeedStatistic()
    pairs = zip(inside.values, outside.values, strict=True)
    ratios = [math.inf if math.isinf(far) else far / near for near, far in pairs if near > 0.0]
    return SeedStatistic(tuple(ratios), outside.command)


def sample_errors(
    results: Results, task: StudyTask, model: StudyModel, scenes: TestCondition, runs: int
) -> SeedStatistic:
    """Open-loop error of a model trained on this number of trajectories, cm."""
    labels = (Source.samples, task.name, model.name, scenes.name)
    return results.statistic(ModelCondition(*labels, training_runs=runs), RECORDED_ERROR)


def _more_data(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> Claim:
    """Claim 3."""
    sizes, most = amounts.sample_sizes, max(amounts.sample_sizes)
    claim = Claim(
        3,
        "No-GIM-Aug generalises, but needs three to four times the data",
        "No-GIM-Aug generalizes well […] however, this comes at the cost of three to four "
        "times more data and longer training time",
        "out of distribution No-GIM-Aug reaches the open-loop error that GIM-Temp has "
        f"with its training runs, with at least {_MORE_DATA:g} times as many but no more than "
        f"{most} runs, on each of these tasks (median over seeds)",
        results,
        [task.name for task in tasks],
    )
    for task in tasks:
        few = task.training_runs
        own = sample_errors(results, task, GIM_TEMP, task.hardest, few)
        curve = [sample_errors(results, task, NO_GIM_AUG, task.hardest, size) for size in sizes]
        claim.add(f"GIM-Temp, {few} runs", task.name, "cm", own)
        claim.add(f"No-GIM-Aug, {most} runs", task.name, "cm", curve[-1])
        ratios = [
            data_ratio(sizes, [one.values[seed] for one in curve], few, own.values[seed])
            for seed in range(min(len(one.values) for one in (own, *curve)))
        ]
        known = tuple(ratio for ratio in ratios if ratio is not None)
        needed = SeedStatistic(known, curve[-1].command)
        reached = math.isfinite(needed.median)
        if needed.known:
            claim.add("data needed for equal error", task.name, "times", needed)
        claim.judge(
            reached and needed.median >= _MORE_DATA,
            [needed],
            f"{task.name}: No-GIM-Aug needs {short(needed.median)} times the data"
            if reached
            else f"{task.name}: not reached with {most}: No-GIM-Aug is at "
            f"{with_unit(curve[-1].median, 'cm')} there, GIM-Temp at "
            f"{with_unit(own.median, 'cm')} with {few}, so it needs more than "
            f"{most / few:g} times the data",
        )
    return claim


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


def _times(ratio: float) -> str:
    return "not finite against" if math.isinf(ratio) else f"{short(ratio)} times"
