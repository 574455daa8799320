"""Figures of the study of models."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from contactgraph.viz.scene_picture import INK, SOFT
from contactgraph_studies import figures
from contactgraph_studies.figures import LEGEND, TEXT
from contactgraph_studies.job import Measurement
from contactgraph_studies.paper import jobs
from contactgraph_studies.paper.claims import sample_errors
from contactgraph_studies.paper.config import (
    FAULTS,
    GIM_NON_TEMP,
    GIM_TEMP,
    NO_GIM_AUG,
    Amounts,
    StudyModel,
    StudyTask,
)
from contactgraph_studies.paper.jobs import Source, planned, recorded
from contactgraph_studies.results import Quantity, Results, SeedStatistic
from contactgraph_studies.study import Picture

_LOWEST_CM, _HIGHEST_CM = 1e-3, 1e3
_DOTTED = (0, (2, 3))
_BASELINES = {
    "baseline: constant velocity": (jobs.CONSTANT_VELOCITY, ":"),
    "baseline: fixed contact": (jobs.FIXED_CONTACT, "--"),
}


def figure_pictures(
    folder: Path, results: Results, tasks: Sequence[StudyTask], amounts: Amounts
) -> list[Picture]:
    """The paper's figures, written to ``figures/NAME.png`` and ``.svg`` in the folder."""
    drawn = [
        (
            "n-step-error",
            "N-step error in and out of distribution",
            "Planned against executed positions, 0.5 s ahead, all bodies; median and range over "
            "training seeds. The dotted line at 1 cm is the paper's bound in distribution. A "
            "controller that moves no object has no error; bodies at rest lower it.",
            error_figure(results, tasks),
        ),
        (
            "edge-accuracy",
            "Edges predicted wrongly in closed loop",
            "100 % less the N-step edge accuracy: lower is better.",
            edge_figure(results, tasks),
        ),
        (
            "sensor-faults",
            "Edges predicted wrongly with a faulty contact sensor",
            "On recorded runs, in distribution. The gain by measured contacts is the distance "
            "from no sensor to exact.",
            fault_figure(results, tasks),
        ),
    ]
    sampled = [task for task in tasks if task.with_samples]
    if sampled:
        title = "Error against the number of training runs"
        caption = "On recorded runs; solid out of distribution, dashed as trained."
        figure = sample_figure(results, sampled, amounts)
        drawn.append(("sample-efficiency", title, caption, figure))
    return [figures.write_figure(folder, *one) for one in drawn]


def scene_pictures(
    folder: Path, tasks: Sequence[StudyTask], measurements: Sequence[Measurement]
) -> tuple[list[Picture], list[Picture]]:
    """Episodes of GIM-Temp (first seed) under every condition; inferred parameters per task."""
    first_jobs = {one.condition: one.job for one in reversed(measurements)}
    scenes, parameters = [], []
    for task, condition in [(one, each) for one in tasks for each in one.conditions]:
        job = first_jobs.get(planned(task, GIM_TEMP, condition))
        if job is None:
            continue
        title, name = f"{task.name}, {condition.name}", f"scene-{task.name}-{condition.slug}"
        model = folder / job.needs[0].output / "model.safetensors"
        scene = figures.first_episode(folder / job.output, model, title)
        if scene is None:
            continue
        caption = "A closed-loop episode of GIM-Temp, replanned every half second."
        scenes.append(figures.write_scene(folder, name, caption, scene))
        if condition is task.as_trained:
            title, name = f"Belief and learned parameters, {task.name}", f"parameters-{task.name}"
            caption = "Predictions before every step; bands mark contact of the first edge named."
            figure = figures.parameter_figure(scene)
            parameters.append(figures.write_figure(folder, name, title, caption, figure))
    return scenes, parameters


def error_figure(results: Results, tasks: Sequence[StudyTask]) -> Figure:
    """N-step error of every model, in and out of distribution; log axis."""
    figure, panels = figures.panel_row(tasks, 4.6, 1.6, 4.4)
    for axes, task in zip(panels, tasks, strict=True):
        _draw_bars(axes, results, task, task.models, jobs.PLANNED_ERROR)
        for group, condition in enumerate((task.as_trained, task.hardest)):
            for name, (quantity, style) in _BASELINES.items():
                baseline = results.statistic(planned(task, GIM_TEMP, condition), quantity)
                if baseline.known:
                    ends, height = [group - 0.46, group + 0.46], [baseline.median] * 2
                    label = name if group == 0 else "_"
                    axes.plot(ends, height, color=SOFT, lw=1.2, ls=style, label=label)
        axes.axhline(1.0, color=INK, lw=0.7, ls=_DOTTED)
        axes.set_yscale("log")
    # A model that stands still predicts to a nanometre, one that diverges is off by kilometres:
    # neither may set the range of the axis.
    bottom, top = panels[0].get_ylim()
    panels[0].set_ylim(max(bottom, _LOWEST_CM), min(top, _HIGHEST_CM))
    panels[0].set_ylabel("N-step error, planned against executed, cm", **TEXT)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3 * len(tasks), **LEGEND)
    return figure


def edge_figure(results: Results, tasks: Sequence[StudyTask]) -> Figure:
    """Edges predicted wrongly in closed loop: 100 % less the accuracy."""
    figure, panels = figures.panel_row(tasks, 3.6, 0.6, 3.6, share_y=False)
    for axes, task in zip(panels, tasks, strict=True):
        _draw_bars(axes, results, task, (GIM_TEMP, GIM_NON_TEMP), _wrong(jobs.PLANNED_ACCURACY))
        axes.set_ylim(bottom=0.0)
    panels[0].set_ylabel("edges predicted wrongly, %", **TEXT)
    panels[-1].legend(**LEGEND)
    return figure


def fault_figure(results: Results, tasks: Sequence[StudyTask]) -> Figure:
    """Edges predicted wrongly on recorded trajectories, by fault of the contact sensor."""
    figure, panels = figures.panel_row(tasks, 3.6, 1.6, 4.0)
    names = ["exact", "no sensor", *(fault.name for fault in FAULTS)]
    wrong, unmeasured = _wrong(jobs.EDGE_ACCURACY), _wrong(jobs.UNMEASURED_ACCURACY)
    for axes, task in zip(panels, tasks, strict=True):
        own = recorded(task, GIM_TEMP, task.as_trained)
        rows = [(own, wrong), (own, unmeasured)]
        rows += [(replace(own, source=Source.faults, sensor=one.name), wrong) for one in FAULTS]
        median, ranges = _ranges([results.statistic(*row) for row in rows])
        style: dict[str, Any] = {"color": GIM_TEMP.colour, "label": GIM_TEMP.name}
        axes.errorbar(median, range(len(rows)), xerr=ranges, fmt="o", ms=5, **style)
        other = results.statistic(recorded(task, GIM_NON_TEMP, task.as_trained), wrong)
        axes.axvline(other.median, color=GIM_NON_TEMP.colour, lw=1.4, label=GIM_NON_TEMP.name)
        axes.set_xlim(left=0.0)
        axes.set_xlabel("edges predicted wrongly, %", **TEXT)
    panels[0].set_yticks(range(len(names)), names)
    panels[0].invert_yaxis()
    panels[-1].legend(**LEGEND)
    return figure


def sample_figure(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> Figure:
    """Open-loop error against the number of training trajectories."""
    figure, panels = figures.panel_row(tasks, 5.0, 0.6, 4.0)
    sizes = amounts.sample_sizes
    for axes, task in zip(panels, tasks, strict=True):
        for model in (GIM_TEMP, NO_GIM_AUG):
            for condition, style in ((task.as_trained, "--"), (task.hardest, "-")):
                every = [sample_errors(results, task, model, condition, size) for size in sizes]
                median, ranges = _ranges(every)
                label = f"{model.name}, {condition.name}"
                line: dict[str, Any] = {"color": model.colour, "ls": style, "label": label}
                axes.errorbar(
                    sizes, median, ranges, marker="o", ms=4, lw=1.6, elinewidth=1.0, **line
                )
        if np.isfinite(axes.dataLim.intervaly).all():  # an empty log axis is an error
            axes.set_yscale("log")
        axes.set_xscale("log")
        axes.axvline(task.training_runs, color=SOFT, lw=0.7, ls=_DOTTED)
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel("training runs", **TEXT)
        axes.legend(**LEGEND)
    panels[0].set_ylabel("N-step error on recorded runs, cm", **TEXT)
    return figure


def _draw_bars(
    axes: Axes,
    results: Results,
    task: StudyTask,
    models: Sequence[StudyModel],
    quantity: Quantity,
) -> None:
    """Bars side by side: a number of the closed loop for every model, in both kinds of scenes.

    A bar is the median, its whisker the range over seeds. Infinity is a hatched bar to the top; a
    statistic that is not known leaves a gap.
    """
    conditions, width = (task.as_trained, task.hardest), 0.84 / len(models)
    statistics: Mapping[tuple[int, int], SeedStatistic] = {
        (column, group): results.statistic(planned(task, model, condition), quantity)
        for column, model in enumerate(models)
        for group, condition in enumerate(conditions)
    }
    values = [value for one in statistics.values() for value in one.values]
    top = 1.6 * max(filter(math.isfinite, values), default=1.0)
    for (column, group), one in statistics.items():
        x, colour = group + (column - (len(models) - 1) / 2.0) * width, models[column].colour
        label = models[column].name if group == 0 else "_"
        if not one.known:
            axes.bar(x, 0.0, width, color=colour, label=label)
        elif math.isfinite(one.median):
            axes.bar(x, one.median, 0.92 * width, color=colour, label=label)
            if len(one.values) > 1:
                high = one.high if math.isfinite(one.high) else top
                axes.plot([x, x], [one.low, high], color=INK, lw=1.0)
        else:
            axes.bar(x, top, 0.92 * width, color="none", ec=colour, hatch="///", label=label)
            axes.text(x, top, "not finite", rotation=90, fontsize=7, color=SOFT, ha="center")
    axes.set_xticks(range(len(conditions)), [condition.name for condition in conditions])


def _ranges(statistics: Sequence[SeedStatistic]) -> tuple[list[float], np.ndarray]:
    """Medians, and how far the ranges over seeds go below and above them; NaN if not known."""
    below = [one.median - one.low for one in statistics]
    above = [one.high - one.median for one in statistics]
    return [one.median for one in statistics], np.array([below, above])


def _wrong(accuracy: Quantity) -> Quantity:
    """100 % less an accuracy."""
    return Quantity(accuracy.key, "%", derived=lambda values: 100.0 - accuracy.read(values))
