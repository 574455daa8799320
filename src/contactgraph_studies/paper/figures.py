"""Figures of the study of models."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from contactgraph.data import read_trajectories
from contactgraph.model.io import load_model
from contactgraph.viz import scene_trajectory
from contactgraph.viz.figures import LEGEND, TEXT, new_figure, parameter_figure
from contactgraph.viz.scene_picture import INK, SOFT
from contactgraph.viz.summary_figure import style_axes
from contactgraph_studies.bootstrap import estimate
from contactgraph_studies.job import Measurement
from contactgraph_studies.paper import jobs
from contactgraph_studies.paper.config import (
    Family,
    StudyModel,
    StudyTask,
    families_of,
)
from contactgraph_studies.paper.jobs import (
    closed_error,
    planned,
)
from contactgraph_studies.results import Results
from contactgraph_studies.study import Picture, write_figure

_LOWEST_CM, _HIGHEST_CM = 1e-3, 1e3
_DOTTED = (0, (2, 3))
_BASELINES = {
    "baseline: constant velocity": (jobs.CONSTANT_VELOCITY, ":"),
    "baseline: fixed contact": (jobs.FIXED_CONTACT, "--"),
}


def figure_pictures(folder: Path, results: Results, tasks: Sequence[StudyTask]) -> list[Picture]:
    """The paper's figure of errors, written to ``figures/NAME.png`` in the folder."""
    title = "N-step error in and out of distribution"
    caption = (
        "Planned against executed positions, 0.5 s ahead, over the bodies that move. Each "
        "training is a point, beside the median with its interval of 95 % over trainings and "
        "scenes; a triangle is a plan that diverged. The dotted line at 1 cm is the paper's "
        "bound in distribution. A controller that moves no object has no error. The baselines "
        "are over all bodies."
    )
    figure = error_figure(results, tasks)
    return [write_figure(folder, "n-step-error", title, caption, figure)]


def parameter_pictures(
    folder: Path, tasks: Sequence[StudyTask], measurements: Sequence[Measurement]
) -> list[Picture]:
    """Belief and parameters that GIM-Temp (first seed) infers in an episode, for each family."""
    first_jobs = {one.condition: one.job for one in reversed(measurements)}
    caption = "Predictions before every step; bands mark contact of the first edge named."
    pictures = []
    for task, family in [(one, each) for one in tasks for each in one.families]:
        job = first_jobs.get(planned(task, family.gim_temp, task.as_trained))
        if job is None:
            continue
        title = f"Belief and learned parameters, {task.name}, {family.name}"
        model = folder / job.needs[0].output / "model.safetensors"
        trajectories = (folder / job.output).with_suffix(".h5")
        if trajectories.is_file() and model.is_file():
            first = read_trajectories(trajectories).trajectories[0]
            scene = scene_trajectory(load_model(model).model, task.name, first)
            name = f"parameters-{task.name}-{family.slug}"
            drawn = parameter_figure(scene)
            pictures.append(write_figure(folder, name, title, caption, drawn))
    return pictures


def error_figure(results: Results, tasks: Sequence[StudyTask]) -> Figure:
    """N-step error of every model in and out of distribution; log axis.

    A row of panels for each family, a column for each task.
    """
    families = families_of(tasks)
    figure = new_figure(4.6 * len(tasks) + 0.6, 3.0 * len(families) + 0.8)
    grid = figure.subplots(len(families), len(tasks), squeeze=False, sharey=True)
    named: dict[str, Any] = {}
    for row, family in zip(grid, families, strict=True):
        for axes, task in zip(row, tasks, strict=True):
            axes.set_title(f"{task.name}, {family.name}", fontsize=11, color=INK, loc="left")
            style_axes(axes)
            if family in task.families:
                _draw_errors(axes, results, task, family)
            for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
                named.setdefault(name.split(", ")[0], handle)
        row[0].set_ylabel("N-step error of moving bodies, cm", **TEXT)
    columns = max(1, len(named) // 2)
    figure.legend(named.values(), named, loc="outside lower center", ncols=columns, **LEGEND)
    return figure


def _draw_errors(axes: Axes, results: Results, task: StudyTask, family: Family) -> None:
    _draw_points(axes, results, task, [each for each in family.models if each in task.models])
    for group, condition in enumerate((task.as_trained, task.hardest)):
        for name, (quantity, style) in _BASELINES.items():
            baseline = results.statistic(planned(task, family.gim_temp, condition), quantity)
            if baseline.known:
                ends, height = [group - 0.46, group + 0.46], [baseline.median] * 2
                axes.plot(ends, height, color=SOFT, lw=1.2, ls=style, label=name)
    axes.axhline(1.0, color=INK, lw=0.7, ls=_DOTTED)
    axes.set_yscale("log")
    # A model that diverges is off by kilometres: it may not set the range of the axis.
    axes.set_ylim(_LOWEST_CM, _HIGHEST_CM)


def _draw_points(
    axes: Axes,
    results: Results,
    task: StudyTask,
    models: Sequence[StudyModel],
) -> None:
    """Side by side: each training a point, their median a line, its interval of 95 % a whisker.

    What is infinite lies on the upper edge, as a triangle.
    """
    conditions, width = (task.as_trained, task.hardest), 0.84 / len(models)
    top = axes.get_xaxis_transform()
    for column, model in enumerate(models):
        for group, condition in enumerate(conditions):
            x = group + (column - (len(models) - 1) / 2.0) * width
            found = estimate([closed_error(results, task, model, condition)])
            colour = model.colour
            finite = [value for value in found.each if math.isfinite(value)]
            points: dict[str, Any] = {"ms": 4, "mew": 0, "alpha": 0.6, "label": model.name}
            axes.plot([x] * len(finite), finite, "o", color=colour, **points)
            if len(finite) < len(found.each):
                axes.plot(x, 0.99, "^", ms=6, c=colour, transform=top, clip_on=False)
            if math.isfinite(found.value):
                ends = [x - 0.35 * width, x + 0.35 * width]
                axes.plot(ends, [found.value] * 2, color=colour, lw=2.0)
                high = found.high if math.isfinite(found.high) else 10.0 * _HIGHEST_CM
                axes.plot([x, x], [found.low, high], color=colour, lw=1.0)
    axes.set_xticks(range(len(conditions)), [condition.name for condition in conditions])
    axes.set_xlim(-0.5, len(conditions) - 0.5)
