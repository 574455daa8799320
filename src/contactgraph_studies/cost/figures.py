"""Figures of the study of learned costs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from contactgraph.control import read_cost
from contactgraph.viz import cost_figure
from contactgraph.viz.figures import LEGEND, TEXT
from contactgraph.viz.scene_picture import BODY_COLOURS, SOFT
from contactgraph_studies.cost.config import (
    CostAmounts,
    by_demonstrations,
    known_answers,
)
from contactgraph_studies.cost.jobs import CostLabels, control, learning
from contactgraph_studies.cost.known_answer import read_answers
from contactgraph_studies.figures import panel_row, write_figure
from contactgraph_studies.job import Measurement
from contactgraph_studies.paper.config import StudyTask
from contactgraph_studies.results import SUCCESS_PERCENT, Results
from contactgraph_studies.study import Picture


def success_figure(results: Results, tasks: Sequence[StudyTask], amounts: CostAmounts) -> Figure:
    """Success by number of demonstrations: all seeds with their interval, and each as a dot."""
    figure, panels = panel_row(tasks, 3.6, 0.6, 3.8)
    counts = amounts.demonstrations
    for axes, task in zip(panels, tasks, strict=True):
        pooled, seeds = [], []
        for position, test in enumerate(by_demonstrations(amounts)):
            labels = control(task, test)
            success = results.success(labels)
            if success is not None:
                pooled.append([position, success.rate, *success.interval])
                each = results.statistic(labels, SUCCESS_PERCENT).values
                seeds += [(position + 0.1, percent) for percent in each]
        x, rate, low, high = np.reshape(pooled, (-1, 4)).T * [[1.0], [100.0], [100.0], [100.0]]
        line: dict[str, Any] = {"color": BODY_COLOURS[0], "lw": 1.6, "ms": 5}
        ends = np.abs([rate - low, high - rate])
        axes.errorbar(x, rate, ends, fmt="o-", label="all seeds, 95 % interval", **line)
        dots = np.reshape(seeds, (-1, 2)).T
        axes.plot(*dots, "o", color=SOFT, ms=3, alpha=0.7, label="each seed")
        axes.set_xticks(range(len(counts)), [str(count) for count in counts])
        axes.set_xlim(-0.5, len(counts) - 0.5)
        axes.set_xlabel("demonstrations", **TEXT)
    panels[0].set_ylabel("success, %", **TEXT)
    panels[-1].legend(**LEGEND, loc="lower right")
    return figure


def cost_pictures(
    results: Results,
    folder: Path,
    measurements: Sequence[Measurement],
    tasks: Sequence[StudyTask],
    amounts: CostAmounts,
) -> list[Picture]:
    """The figures, written to ``figures/NAME.png`` in the folder."""
    title = "Success with unseen goals and objects"
    caption = "By the number of demonstrations that the cost was learned from."
    figure = success_figure(results, tasks, amounts)
    pictures = [write_figure(folder, "success", title, caption, figure)]
    for task in tasks:
        most = by_demonstrations(amounts)[-1].learned
        path = _output(folder, measurements, learning(task, most))
        if path is not None:
            title = f"The learned cost, {task.name}"
            caption = f"From {amounts.most} demonstrations with one goal, the first seed's."
            figure = cost_figure(read_cost(path))
            pictures.append(write_figure(folder, f"cost-{task.name}", title, caption, figure))
        for learned in known_answers(amounts):
            for answer in read_answers(folder, measurements, task, learned)[:1]:
                figure = cost_figure(answer.learned, answer.hidden)
                name = f"known-{learned.demonstrator.slug}-{task.name}"
                caption = (
                    f"Learned from {learned.demonstrations} runs of {learned.name}, the first "
                    "seed's; below it that cost."
                )
                title = f"A known answer, {task.name}"
                pictures.append(write_figure(folder, name, title, caption, figure))
    return pictures


def _output(folder: Path, measurements: Sequence[Measurement], labels: CostLabels) -> Path | None:
    """Of the first seed; None if it does not exist."""
    paths = (folder / one.job.output for one in measurements if one.condition == labels)
    path = next(paths, None)
    return path if path is not None and path.is_file() else None
