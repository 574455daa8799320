"""From what a model did under test conditions to a page, and beside it tables and a still."""

from collections.abc import Callable
from pathlib import Path

from contactgraph.cli.conditions import Conditions
from contactgraph.cli.models import model_path
from contactgraph.cli.output import provenance, write_json, write_text
from contactgraph.cli.tasks import TASKS, TaskOptions, task_factory
from contactgraph.data import Trajectory
from contactgraph.evaluate import EpisodeRecord, control_task
from contactgraph.model.io import describe_model, load_model
from contactgraph.train import RunFolder
from contactgraph.viz import SceneRun, write_report, write_summary_figure
from contactgraph.viz.model_report import ModelResult, model_report, report_numbers
from contactgraph.viz.number_table import csv_numbers, markdown_numbers
from contactgraph_studies.scenes import scene_run


def measured(model_name: str, conditions: Conditions, folder: Path) -> ModelResult:
    """One model under all test conditions."""
    path = model_path(model_name)
    training = describe_model(path).training
    done = conditions.measure(model_name, folder)
    return ModelResult(
        task=conditions.task,
        seed=int(training.get("seed", 0)),
        conditions=done,
        training_s=float(training.get("training_s", "nan")),
        model_bytes=path.stat().st_size,
        training_command=str(training.get("command", "")),
    )


def write_report_files(page: Path, result: ModelResult, model_name: str, command: str) -> None:
    """The page, and beside it the table (Markdown, CSV, JSON) and a still of one scene."""
    metrics = RunFolder(Path(model_name)).metrics() if Path(model_name).is_dir() else []
    numbers = report_numbers(result)
    folder = page.parent
    folder.mkdir(parents=True, exist_ok=True)
    scenes = _scenes(model_name, result)
    versions = provenance()["versions"]
    write_report(page, model_report(result, numbers, scenes, metrics, versions, [command]))
    write_summary_figure(folder / f"{result.task.name}.png", scenes[min(1, len(scenes) - 1)])
    write_text(folder / "table.md", markdown_numbers(numbers))
    write_text(folder / "table.csv", csv_numbers(numbers))
    write_json(
        folder / "results.json",
        {
            "numbers": [
                {
                    "what": number.name,
                    "unit": number.unit,
                    "value": number.value,
                    "interval": number.interval,
                    "at_least": number.at_least,
                    "aim": number.aim,
                    "reached": number.reached,
                    "command": number.command,
                }
                for number in numbers
            ],
            "training_seed": result.seed,
            "remake": [command],
            **provenance(),
        },
    )
    print(markdown_numbers(numbers))
    print(f"the report: {page}")


def _scenes(model_name: str, result: ModelResult) -> list[SceneRun]:
    """The first closed-loop episode of every condition, with its plans."""
    model = load_model(model_path(model_name)).model
    scenes = []
    for one in result.conditions:
        records: list[EpisodeRecord] = []
        condition = one.condition
        _, runs = control_task(
            model,
            task_factory(result.task.name, TaskOptions(condition.distractors, condition.objects)),
            episodes=1,
            seed=one.seed,
            horizon=TASKS[result.task.name].horizon,
            on_episode=_into(records),
        )
        scenes.append(scene_run(model, condition.name, runs[0], records[0].plan))
    return scenes


def _into(records: list[EpisodeRecord]) -> Callable[[Trajectory, EpisodeRecord], None]:
    return lambda run, record: records.append(record)
