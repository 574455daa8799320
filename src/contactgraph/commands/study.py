"""What report and reproduce share: from commands' outputs to a table and a page."""

from collections.abc import Callable, Sequence
from pathlib import Path

from contactgraph.commands.conditions import Conditions
from contactgraph.commands.names import model_path, task_factory
from contactgraph.commands.output import say, write_json
from contactgraph.commands.provenance import provenance
from contactgraph.data import Trajectory, replacing
from contactgraph.evaluate import EpisodeRecord, control_task
from contactgraph.model.storage import describe_model, load_model
from contactgraph.reproduce.figures import SeedResult, pickup_figures
from contactgraph.reproduce.page import pickup_report
from contactgraph.reproduce.scenes import scene_run
from contactgraph.reproduce.table import csv_table, markdown_table
from contactgraph.train import RunFolder
from contactgraph.view import SceneRun, write_report, write_still


def measured(run_name: str, conditions: Conditions, folder: Path, keep: bool) -> SeedResult:
    """One model under all test conditions; `keep` leaves out what is in the folder already."""
    path = model_path(run_name)
    training = describe_model(path).training
    done = conditions.measure(run_name, folder, keep)
    return SeedResult(
        seed=int(training.get("seed", 0)),
        conditions={condition.distractors: condition for condition in done},
        training_s=float(training.get("training_s", "nan")),
        model_bytes=path.stat().st_size,
        training_command=str(training.get("command", "")),
    )


def write_study(
    page: Path,
    results: Sequence[SeedResult],
    run_names: Sequence[str],
    task: str,
    remake: Sequence[str],
) -> None:
    """The page, and beside it the table (Markdown, CSV, JSON) and a still of one scene.

    Scenes and training curves are those of the first run.
    """
    run_name = run_names[0]
    metrics = RunFolder(Path(run_name)).metrics() if Path(run_name).is_dir() else []
    figures = pickup_figures(results)
    folder = page.parent
    folder.mkdir(parents=True, exist_ok=True)
    scenes = _scenes(run_name, task, results[0])
    versions = provenance()["versions"]
    write_report(page, pickup_report(results, figures, scenes, metrics, versions, remake))
    write_still(folder / "pickup.png", scenes[min(1, len(scenes) - 1)])
    _write(folder / "table.md", markdown_table(figures))
    _write(folder / "table.csv", csv_table(figures))
    write_json(
        folder / "results.json",
        {
            "figures": [
                {
                    "what": figure.name,
                    "unit": figure.unit,
                    "values": list(figure.values),
                    "at_least": figure.at_least,
                    "aim": figure.aim,
                    "reached": figure.reached,
                    "command": figure.command,
                }
                for figure in figures
            ],
            "training_seeds": [result.seed for result in results],
            "remake": list(remake),
            **provenance(),
        },
    )
    say(markdown_table(figures))
    say(f"the report: {page}")


def _scenes(run_name: str, task: str, result: SeedResult) -> list[SceneRun]:
    """The first closed-loop episode of every condition, with its plans."""
    model = load_model(model_path(run_name)).model
    scenes = []
    for distractors, condition in result.conditions.items():
        records: list[EpisodeRecord] = []
        _, runs = control_task(
            model,
            task_factory(task, distractors, None),
            episodes=1,
            seed=condition.seed,
            on_episode=_into(records),
        )
        name = f"{distractors} distractors" if distractors else "no distractors"
        scenes.append(scene_run(model, name, runs[0], records[0].plan))
    return scenes


def _into(records: list[EpisodeRecord]) -> Callable[[Trajectory, EpisodeRecord], None]:
    return lambda run, record: records.append(record)


def _write(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text)
