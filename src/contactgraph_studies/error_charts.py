"""The paper's figures of errors and edges, redrawn from what was measured."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure as Chart
from matplotlib.ticker import NullLocator

from contactgraph_studies.chart import COLOURS, INK, SOFT, bars, chart, quiet
from contactgraph_studies.claims_error import planned, sample_errors
from contactgraph_studies.claims_graph import recorded
from contactgraph_studies.declared import (
    FAULTS,
    GIM_NON_TEMP,
    GIM_TEMP,
    NO_GIM_AUG,
    Amounts,
    StudyTask,
)
from contactgraph_studies.plan_cells import Source, Where
from contactgraph_studies.results import Figure, Results
from contactgraph_studies.study_table import Row

_LOWEST_CM, _HIGHEST_CM = 1e-3, 1e3


def error_chart(table: Sequence[Row], tasks: Sequence[StudyTask]) -> Chart:
    """N-step error of every model, in and out of distribution; a panel a task, log axis."""
    made = chart(4.6 * len(tasks) + 1.6, 4.4)
    panels = made.subplots(1, len(tasks), squeeze=False, sharey=True)[0]
    for axes, task in zip(panels, tasks, strict=True):
        conditions = (task.as_trained, task.hardest)
        found = {(row.condition, row.model): row for row in table if row.task == task.name}
        series = [
            (
                model.name,
                COLOURS[model.name],
                [found[condition, model.name].planned for condition in conditions],
            )
            for model in task.models
        ]
        bars(axes, [condition.name for condition in conditions], series)
        _floors(axes, [found[condition, GIM_TEMP.name] for condition in conditions])
        axes.axhline(1.0, color=INK, lw=0.7, ls=(0, (2, 3)))
        axes.set_yscale("log")
        quiet(axes, task.name)
    # A model that stands still predicts to a nanometre, one that runs away is off by kilometres:
    # neither may squeeze what is of interest.
    bottom, top = panels[0].get_ylim()
    panels[0].set_ylim(max(bottom, _LOWEST_CM), min(top, _HIGHEST_CM))
    panels[0].set_ylabel("N-step error, planned against executed, cm", color=SOFT, fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    made.legend(
        handles, labels, loc="outside lower center", ncols=3 * len(tasks), fontsize=8, frameon=False
    )
    return made


def _floors(axes: Axes, row_of_group: Sequence[Row]) -> None:
    """What needs no learning, across each group."""
    for group, row in enumerate(row_of_group):
        for name, figure, style in (
            ("floor: constant velocity", row.constant_velocity, ":"),
            ("floor: frozen contact", row.frozen_contact, "--"),
        ):
            if figure.known:
                axes.plot(
                    [group - 0.46, group + 0.46],
                    [figure.median] * 2,
                    color=SOFT,
                    lw=1.2,
                    ls=style,
                    label=name if group == 0 else "_",
                )


def edge_chart(results: Results, tasks: Sequence[StudyTask]) -> Chart:
    """Edges predicted wrongly in closed loop: 100 % less the accuracy, so that it can be seen."""
    made = chart(3.6 * len(tasks) + 0.6, 3.6)
    panels = made.subplots(1, len(tasks), squeeze=False)[0]
    for axes, task in zip(panels, tasks, strict=True):
        conditions = (task.as_trained, task.hardest)
        series = []
        for model in (GIM_TEMP, GIM_NON_TEMP):
            wrong = [
                _wrong(results, planned(task, model, condition), "edge_accuracy_planned")
                for condition in conditions
            ]
            series.append((model.name, COLOURS[model.name], wrong))
        bars(axes, [condition.name for condition in conditions], series)
        axes.set_ylim(bottom=0.0)
        quiet(axes, task.name)
    panels[0].set_ylabel("edges predicted wrongly, %", color=SOFT, fontsize=9)
    panels[-1].legend(fontsize=8, frameon=False)
    return made


def _wrong(results: Results, where: Where, key: str) -> Figure:
    right = results.number(where, key, 100.0)
    return Figure(tuple(100.0 - value for value in right.values), right.command)


def fault_chart(results: Results, tasks: Sequence[StudyTask]) -> Chart:
    """Edges predicted wrongly on recorded runs, by what is wrong with the contact sensor."""
    made = chart(3.6 * len(tasks) + 1.6, 4.0)
    panels = made.subplots(1, len(tasks), squeeze=False, sharey=True)[0]
    names = ["exact", "no sensor", *(fault.name for fault in FAULTS)]
    for axes, task in zip(panels, tasks, strict=True):
        where = recorded(task, GIM_TEMP, task.as_trained)
        figures = [
            _wrong(results, where, "edge_accuracy"),
            _wrong(results, where, "edge_accuracy_unmeasured"),
        ]
        for fault in FAULTS:
            at = Where(
                Source.faults, task.name, GIM_TEMP.name, task.as_trained.name, fault=fault.name
            )
            figures.append(_wrong(results, at, "edge_accuracy"))
        for place, figure in enumerate(figures):
            colour = COLOURS[GIM_TEMP.name]
            axes.plot([figure.low, figure.high], [place] * 2, color=colour, lw=1.4)
            label = GIM_TEMP.name if place == 0 else "_"
            axes.plot(figure.median, place, "o", color=colour, ms=5, label=label)
        other = _wrong(results, recorded(task, GIM_NON_TEMP, task.as_trained), "edge_accuracy")
        axes.axvline(
            other.median, color=COLOURS[GIM_NON_TEMP.name], lw=1.4, label=GIM_NON_TEMP.name
        )
        quiet(axes, task.name)
        axes.set_xlim(left=0.0)
        axes.set_xlabel("edges predicted wrongly, %", color=SOFT, fontsize=9)
    panels[0].set_yticks(range(len(names)), names)
    panels[0].invert_yaxis()
    panels[-1].legend(fontsize=8, frameon=False)
    return made


def sample_chart(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> Chart:
    """Open-loop error against the number of training runs, in and out of distribution."""
    measured = [task for task in tasks if task.with_samples]
    made = chart(5.0 * len(measured) + 0.6, 4.0)
    panels = made.subplots(1, len(measured), squeeze=False, sharey=True)[0]
    for axes, task in zip(panels, measured, strict=True):
        for model in (GIM_TEMP, NO_GIM_AUG):
            for condition, style in ((task.as_trained, "--"), (task.hardest, "-")):
                points = [
                    (runs, sample_errors(results, task, model, condition, runs))
                    for runs in amounts.sample_sizes
                ]
                points = [(runs, figure) for runs, figure in points if figure.known]
                colour = COLOURS[model.name]
                axes.plot(
                    [runs for runs, _ in points],
                    [figure.median for _, figure in points],
                    color=colour,
                    ls=style,
                    marker="o",
                    ms=4,
                    lw=1.6,
                    label=f"{model.name}, {condition.name}",
                )
                for runs, figure in points:
                    axes.plot([runs] * 2, [figure.low, figure.high], color=colour, lw=1.0)
        if any(line.get_xydata().size for line in axes.lines):  # a log axis of nothing is an error
            axes.set_yscale("log")
        axes.set_xscale("log")
        axes.axvline(task.training_runs, color=SOFT, lw=0.7, ls=(0, (2, 3)))
        axes.set_xticks(amounts.sample_sizes, [str(runs) for runs in amounts.sample_sizes])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel("training runs", color=SOFT, fontsize=9)
        axes.legend(fontsize=8, frameon=False)
        quiet(axes, task.name)
    panels[0].set_ylabel("N-step error on recorded runs, cm", color=SOFT, fontsize=9)
    return made
