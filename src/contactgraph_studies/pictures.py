"""The study's pictures, written to files and handed to the page."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure as Chart

from contactgraph.data import read_trajectories
from contactgraph.model.io import load_model
from contactgraph.viz import SceneRun, scene_run, write_summary_figure
from contactgraph_studies.chart import svg, write_chart
from contactgraph_studies.declared import GIM_TEMP, Amounts, StudyTask
from contactgraph_studies.error_charts import edge_chart, error_chart, fault_chart, sample_chart
from contactgraph_studies.findings import Picture
from contactgraph_studies.measurement import Measurement
from contactgraph_studies.plan_cells import Source, Where
from contactgraph_studies.results import Results
from contactgraph_studies.run_chart import run_chart
from contactgraph_studies.study_table import Row

_FIGURES = "figures"


def figure_pictures(
    folder: Path,
    results: Results,
    table: Sequence[Row],
    tasks: Sequence[StudyTask],
    amounts: Amounts,
) -> list[Picture]:
    """The paper's figures; ``figures/NAME.png`` and ``.svg`` in the folder."""
    charts = [
        (
            "n-step-error",
            "N-step error in and out of distribution",
            "Plans against what was executed, 0.5 s ahead, all bodies; median and range over "
            "training seeds. The dotted line at 1 cm is the paper's bound in distribution. Read it "
            "beside the success: a controller that does nothing is predicted well.",
            error_chart(table, tasks),
        ),
        (
            "edge-accuracy",
            "Edges predicted wrongly in closed loop",
            "100 % less the N-step edge accuracy: lower is better.",
            edge_chart(results, tasks),
        ),
        (
            "sensor-faults",
            "Edges predicted wrongly with a faulty contact sensor",
            "On recorded runs, in distribution. What measured contacts gain is the way from "
            "no sensor to exact.",
            fault_chart(results, tasks),
        ),
    ]
    if any(task.with_samples for task in tasks):
        charts.append(
            (
                "sample-efficiency",
                "Error against the number of training runs",
                "On recorded runs; solid out of distribution, dashed as trained.",
                sample_chart(results, tasks, amounts),
            )
        )
    return [drawn(folder, *one) for one in charts]


def drawn(folder: Path, name: str, title: str, caption: str, chart: Chart) -> Picture:
    """A chart, written to ``figures/NAME.png`` and ``.svg``."""
    write_chart(folder / _FIGURES, name, chart)
    return Picture(title, caption, svg(chart), "svg+xml")


def still(folder: Path, name: str, title: str, caption: str, run: SceneRun) -> Picture:
    """One moment of a run, written to ``figures/NAME.png``."""
    path = folder / _FIGURES / f"{name}.png"
    write_summary_figure(path, run)
    return Picture(title, caption, path.read_bytes(), "png")


def scene_pictures(
    folder: Path, tasks: Sequence[StudyTask], wanted: Sequence[Measurement[Where]]
) -> tuple[list[Picture], list[Picture]]:
    """Stills of GIM-Temp at work under every condition, and what it inferred in one run a task."""
    stills, insights = [], []
    for task in tasks:
        for condition in task.conditions:
            run = _first_episode(folder, wanted, task.name, condition.name)
            if run is None:
                continue
            name = f"scene-{task.name}-{condition.slug}"
            title = f"{task.name}, {condition.name}"
            caption = "A closed-loop episode of GIM-Temp, planned anew every half second."
            stills.append(still(folder, name, title, caption, run))
            if condition is task.as_trained:
                insights.append(
                    drawn(
                        folder,
                        f"parameters-{task.name}",
                        f"Belief and learned parameters through a run, {task.name}",
                        "As predicted before every step; the band is true contact of the first "
                        "edge named.",
                        run_chart(run),
                    )
                )
    return stills, insights


def _first_episode(
    folder: Path, wanted: Sequence[Measurement[Where]], task: str, condition: str
) -> SceneRun | None:
    """Of the first seed's GIM-Temp, as its model sees it; None where there is none."""
    for one in wanted:
        where = one.where
        if (where.source, where.task, where.model, where.condition) != (
            Source.planned,
            task,
            GIM_TEMP.name,
            condition,
        ):
            continue
        episodes = (folder / one.cell.output).with_suffix(".h5")
        model = folder / one.cell.needs[0].output / "model.safetensors"
        if episodes.is_file() and model.is_file():
            run = read_trajectories(episodes).trajectories[0]
            return scene_run(load_model(model).model, f"{task}, {condition}", run)
    return None
