"""Figures of the study of models."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from contactgraph_studies.figures import (
    INK,
    LEGEND,
    SOFT,
    TEXT,
    first_episode,
    panel_row,
    parameter_figure,
    write_figure,
    write_scene,
)
from contactgraph_studies.job import Measurement
from contactgraph_studies.paper.claims import sample_errors
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
    StudyTask,
)
from contactgraph_studies.paper.jobs import (
    CONSTANT_VELOCITY,
    EDGE_ACCURACY,
    FIXED_CONTACT,
    PLANNED_ACCURACY,
    PLANNED_ERROR,
    UNMEASURED_ACCURACY,
    ModelCondition,
    Source,
    planned,
    recorded,
)
from contactgraph_studies.results import Quantity, Results, SeedStatistic
from contactgraph_studies.study import Picture

_COLOURS = {
    GIM_TEMP.name: "#1b66a8",
    GIM_NON_TEMP.name: "#7fb2dd",
    NO_GIM.name: "#cb5f12",
    NO_GIM_AUG.name: "#eca86f",
    FULL_AB.name: "#7650a3",
    NO_KL.name: "#0d8074",
    LITERAL.name: "#a5a9ae",
    LITERAL_NO_GIM.name: "#6d7278",
}
_LOWEST_CM, _HIGHEST_CM = 1e-3, 1e3
_DOTTED = (0, (2, 3))


def figure_pictures(
    folder: Path, results: Results, tasks: Sequence[StudyTask], amounts: Amounts
) -> list[Picture]:
    """The paper's figures, written to ``figures/NAME.png`` and ``.svg`` in the folder."""
    pictures = [
        write_figure(
            folder,
            "n-step-error",
            "N-step error in and out of distribution",
            "Planned against executed positions, 0.5 s ahead, all bodies; median and range over "
            "training seeds. The dotted line at 1 cm is the paper's bound in distribution. The "
            "error must be read together with the success: a controller that does nothing is "
            "predicted well.",
            error_figure(results, tasks),
        ),
        write_figure(
            folder,
            "edge-accuracy",
            "Edges predicted wrongly in closed loop",
            "100 % less the N-step edge accuracy: lower is better.",
            edge_figure(results, tasks),
        ),
        write_figure(
            folder,
            "sensor-faults",
            "Edges predicted wrongly with a faulty contact sensor",
            "On recorded runs, in distribution. The gain by measured contacts is the distance "
            "from no sensor to exact.",
            fault_figure(results, tasks),
        ),
    ]
    sampled = [task for task in tasks if task.with_samples]
    if sampled:
        figure = sample_figure(results, sampled, amounts)
        title = "Error against the number of training runs"
        caption = "On recorded runs; solid out of distribution, dashed as trained."
        pictures.append(write_figure(folder, "sample-efficiency", title, caption, figure))
    return pictures


def scene_pictures(
    folder: Path, tasks: Sequence[StudyTask], measurements: Sequence[Measurement]
) -> tuple[list[Picture], list[Picture]]:
    """Episodes of GIM-Temp (first seed) under every condition; inferred parameters per task."""
    jobs = {one.condition: one.job for one in reversed(measurements)}
    scenes, parameters = [], []
    for task in tasks:
        for condition in task.conditions:
            job = jobs.get(planned(task, GIM_TEMP, condition))
            if job is None:
                continue
            title = f"{task.name}, {condition.name}"
            model = folder / job.needs[0].output / "model.safetensors"
            scene = first_episode(folder / job.output, model, title)
            if scene is None:
                continue
            name = f"scene-{task.name}-{condition.slug}"
            caption = "A closed-loop episode of GIM-Temp, replanned every half second."
            scenes.append(write_scene(folder, name, title, caption, scene))
            if condition is task.as_trained:
                title = f"Belief and learned parameters along a trajectory, {task.name}"
                caption = (
                    "As predicted before every step; the band marks true contact of the first "
                    "edge named."
                )
                figure = parameter_figure(scene)
                name = f"parameters-{task.name}"
                parameters.append(write_figure(folder, name, title, caption, figure))
    return scenes, parameters


def error_figure(results: Results, tasks: Sequence[StudyTask]) -> Figure:
    """N-step error of every model, in and out of distribution; log axis."""
    titles = [task.name for task in tasks]
    figure, panels = panel_row(4.6 * len(tasks) + 1.6, 4.4, titles)
    for axes, task in zip(panels, tasks, strict=True):
        conditions = (task.as_trained, task.hardest)
        series = {
            model.name: [
                results.statistic(planned(task, model, condition), PLANNED_ERROR)
                for condition in conditions
            ]
            for model in task.models
        }
        draw_bars(axes, [condition.name for condition in conditions], series)
        for group, condition in enumerate(conditions):
            where = planned(task, GIM_TEMP, condition)
            for name, quantity, style in (
                ("baseline: constant velocity", CONSTANT_VELOCITY, ":"),
                ("baseline: fixed contact", FIXED_CONTACT, "--"),
            ):
                baseline = results.statistic(where, quantity)
                if baseline.known:
                    ends, label = [group - 0.46, group + 0.46], name if group == 0 else "_"
                    axes.plot(
                        ends, [baseline.median] * 2, color=SOFT, lw=1.2, ls=style, label=label
                    )
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
    titles = [task.name for task in tasks]
    figure, panels = panel_row(3.6 * len(tasks) + 0.6, 3.6, titles, share_y=False)
    for axes, task in zip(panels, tasks, strict=True):
        conditions = (task.as_trained, task.hardest)
        series = {
            model.name: [
                _wrong(results, planned(task, model, condition), PLANNED_ACCURACY)
                for condition in conditions
            ]
            for model in (GIM_TEMP, GIM_NON_TEMP)
        }
        draw_bars(axes, [condition.name for condition in conditions], series)
        axes.set_ylim(bottom=0.0)
    panels[0].set_ylabel("edges predicted wrongly, %", **TEXT)
    panels[-1].legend(**LEGEND)
    return figure


def fault_figure(results: Results, tasks: Sequence[StudyTask]) -> Figure:
    """Edges predicted wrongly on recorded trajectories, by fault of the contact sensor."""
    titles = [task.name for task in tasks]
    figure, panels = panel_row(3.6 * len(tasks) + 1.6, 4.0, titles)
    names = ["exact", "no sensor", *(fault.name for fault in FAULTS)]
    own, other = _COLOURS[GIM_TEMP.name], _COLOURS[GIM_NON_TEMP.name]
    for axes, task in zip(panels, tasks, strict=True):
        scenes = task.as_trained
        where = recorded(task, GIM_TEMP, scenes)
        faulty = [
            ModelCondition(Source.faults, task.name, GIM_TEMP.name, scenes.name, fault.name)
            for fault in FAULTS
        ]
        statistics = [
            _wrong(results, where, EDGE_ACCURACY),
            _wrong(results, where, UNMEASURED_ACCURACY),
            *(_wrong(results, one, EDGE_ACCURACY) for one in faulty),
        ]
        for position, one in enumerate(statistics):
            axes.plot([one.low, one.high], [position] * 2, color=own, lw=1.4)
            label = GIM_TEMP.name if position == 0 else "_"
            axes.plot(one.median, position, "o", color=own, ms=5, label=label)
        reference = _wrong(results, recorded(task, GIM_NON_TEMP, scenes), EDGE_ACCURACY)
        axes.axvline(reference.median, color=other, lw=1.4, label=GIM_NON_TEMP.name)
        axes.set_xlim(left=0.0)
        axes.set_xlabel("edges predicted wrongly, %", **TEXT)
    panels[0].set_yticks(range(len(names)), names)
    panels[0].invert_yaxis()
    panels[-1].legend(**LEGEND)
    return figure


def sample_figure(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> Figure:
    """Open-loop error against the number of training trajectories."""
    figure, panels = panel_row(5.0 * len(tasks) + 0.6, 4.0, [task.name for task in tasks])
    sizes = amounts.sample_sizes
    for axes, task in zip(panels, tasks, strict=True):
        drawn = 0
        for model in (GIM_TEMP, NO_GIM_AUG):
            for condition, style in ((task.as_trained, "--"), (task.hardest, "-")):
                every = {n: sample_errors(results, task, model, condition, n) for n in sizes}
                known = {size: error for size, error in every.items() if error.known}
                drawn += len(known)
                colour, label = _COLOURS[model.name], f"{model.name}, {condition.name}"
                line: dict[str, Any] = {"ls": style, "marker": "o", "ms": 4, "lw": 1.6}
                medians = [error.median for error in known.values()]
                axes.plot(list(known), medians, color=colour, label=label, **line)
                for size, error in known.items():
                    axes.plot([size] * 2, [error.low, error.high], color=colour, lw=1.0)
        if drawn:  # an empty log axis is an error
            axes.set_yscale("log")
        axes.set_xscale("log")
        axes.axvline(task.training_runs, color=SOFT, lw=0.7, ls=_DOTTED)
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel("training runs", **TEXT)
        axes.legend(**LEGEND)
    panels[0].set_ylabel("N-step error on recorded runs, cm", **TEXT)
    return figure


def draw_bars(axes: Axes, groups: Sequence[str], series: dict[str, list[SeedStatistic]]) -> None:
    """Bars side by side: for every model one statistic for each group.

    A bar is the median, its whisker the range over seeds. Infinity is a hatched bar to the top; a
    statistic that is not known leaves a gap.
    """
    width = 0.84 / len(series)
    values = [value for row in series.values() for one in row for value in one.values]
    top = 1.6 * max(filter(math.isfinite, values), default=1.0)
    for position, (name, statistics) in enumerate(series.items()):
        offset, colour = (position - (len(series) - 1) / 2.0) * width, _COLOURS[name]
        for group, one in enumerate(statistics):
            x, label = group + offset, name if group == 0 else "_"
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
    axes.set_xticks(range(len(groups)), groups)


def _wrong(results: Results, condition: ModelCondition, accuracy: Quantity) -> SeedStatistic:
    right = results.statistic(condition, accuracy)
    return SeedStatistic(tuple(100.0 - value for value in right.values), right.command)
