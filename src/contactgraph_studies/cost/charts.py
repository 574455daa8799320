"""The study's figures: success by number of demonstrations, costs, and scenes."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure as Chart

from contactgraph.control import read_cost
from contactgraph.data import read_trajectories
from contactgraph.model import shipped_model
from contactgraph.model.io import load_model
from contactgraph.viz import cost_figure, scene_run
from contactgraph.viz.scene_picture import BODY_COLOURS
from contactgraph_studies.chart import SOFT, chart, quiet
from contactgraph_studies.cost.cells import Controlled, Learned, Place
from contactgraph_studies.cost.declared import (
    CostAmounts,
    CostTask,
    among_distractors,
    by_runs,
    known_answers,
)
from contactgraph_studies.cost.known_answer import known_answer
from contactgraph_studies.cost.targets import ENOUGH
from contactgraph_studies.findings import Picture
from contactgraph_studies.measurement import Measurement
from contactgraph_studies.pictures import drawn, still
from contactgraph_studies.results import Results
from contactgraph_studies.success import pooled_success

_COLOUR = BODY_COLOURS[0]


def success_chart(results: Results, tasks: Sequence[CostTask], amounts: CostAmounts) -> Chart:
    """A panel a task: all seeds together with their interval, and every seed as a dot."""
    made = chart(3.6 * len(tasks) + 0.6, 3.8)
    panels = made.subplots(1, len(tasks), squeeze=False, sharey=True)[0]
    for axes, task in zip(panels, tasks, strict=True):
        known = []
        for place, trial in enumerate(by_runs(amounts)):
            where = Controlled(task.name, trial)
            pooled = pooled_success(results.readings(where))
            if pooled is None:
                continue
            known.append((place, 100.0 * pooled.share))
            ends = [100.0 * end for end in pooled.interval]
            label = "95 % interval" if place == 0 else "_"
            axes.plot([place] * 2, ends, color=_COLOUR, lw=1.4, label=label)
            seeds = results.number(where, "success_rate", 100.0).values
            label = "each seed" if place == 0 else "_"
            places = [place + 0.1] * len(seeds)
            axes.plot(places, seeds, "o", color=SOFT, ms=3, alpha=0.7, label=label)
        axes.plot(
            [place for place, _ in known],
            [share for _, share in known],
            *("o-",),
            color=_COLOUR,
            lw=1.6,
            ms=5,
            label="all seeds",
        )
        axes.axhline(100.0 * ENOUGH, color=SOFT, lw=0.7, ls=(0, (2, 3)))
        axes.set_xticks(range(len(amounts.runs)), [str(runs) for runs in amounts.runs])
        axes.set_xlim(-0.5, len(amounts.runs) - 0.5)
        axes.set_xlabel("demonstrations", color=SOFT, fontsize=9)
        quiet(axes, task.name)
    panels[0].set_ylabel("success, %", color=SOFT, fontsize=9)
    panels[-1].legend(fontsize=8, frameon=False, loc="lower right")
    return made


def cost_pictures(
    folder: Path,
    results: Results,
    wanted: Sequence[Measurement[Place]],
    tasks: Sequence[CostTask],
    amounts: CostAmounts,
) -> list[Picture]:
    """The figures; ``figures/NAME.png`` and ``.svg`` in the folder."""
    pictures = [
        drawn(
            folder,
            "success",
            "Success with unseen goals and objects",
            "By the number of demonstrations that the cost was learned from. The dotted line is at "
            f"{100 * ENOUGH:.0f} %.",
            success_chart(results, tasks, amounts),
        )
    ]
    for task in tasks:
        lesson = by_runs(amounts)[-1].lesson
        path = _output(folder, wanted, Learned(task.name, lesson))
        if path is not None:
            pictures.append(
                drawn(
                    folder,
                    f"cost-{task.name}",
                    f"What was learned, {task.name}",
                    f"From {amounts.most} demonstrations with one goal, the first seed's.",
                    cost_figure(read_cost(path)),
                )
            )
        for lesson in known_answers(amounts):
            known = known_answer(folder, wanted, task, lesson)
            if not known:
                continue
            pictures.append(
                drawn(
                    folder,
                    f"known-{lesson.demonstrator.slug}-{task.name}",
                    f"A known answer, {task.name}",
                    f"Learned from {lesson.runs} runs of {lesson.name}, the first seed's; below it "
                    "that cost.",
                    cost_figure(known[0].learned, known[0].hidden),
                )
            )
    return pictures


def cost_scenes(
    folder: Path,
    wanted: Sequence[Measurement[Place]],
    tasks: Sequence[CostTask],
    amounts: CostAmounts,
) -> list[Picture]:
    """A still of every task among distractors: the first seed's first episode."""
    stills = []
    for task in tasks:
        path = _output(folder, wanted, Controlled(task.name, among_distractors(amounts)[0]))
        if path is None or not path.with_suffix(".h5").is_file():
            continue
        title = f"{task.name}, {among_distractors(amounts)[0].distractors} distractors in view"
        run = read_trajectories(path.with_suffix(".h5")).trajectories[0]
        model = load_model(shipped_model(task.name)).model
        caption = "A closed-loop episode with the learned cost, planned anew every step."
        shown = scene_run(model, title, run)
        stills.append(still(folder, f"scene-{task.name}", title, caption, shown))
    return stills


def _output(folder: Path, wanted: Sequence[Measurement[Place]], where: Place) -> Path | None:
    """Of the first seed; None where it is not there."""
    for one in wanted:
        if one.where == where:
            path = folder / one.cell.output
            return path if path.is_file() else None
    return None
