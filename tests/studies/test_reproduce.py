"""``contactgraph reproduce``: its studies, files and exit codes."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import pytest

from contactgraph.cli import main as cli
from contactgraph.control import write_cost
from contactgraph_studies import outputs
from contactgraph_studies.cost import config
from contactgraph_studies.cost.known_answer import own_cost
from contactgraph_studies.job import Job, JobRecords
from contactgraph_studies.paper.config import PICKUP
from contactgraph_studies.runner import Failure, Progress

FILES = {"claims.json", "figures", "report.md", "results.json", "table.csv", "table.md"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            "juggling",
            "study must be one of results, pickup, multi-pickup, door, franka, all, cost, "
            "rehearsal; found 'juggling'",
        ),
        ("door --out taken", "--out: taken must be a folder, found a file"),
    ],
)
def test_mistakes(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: str,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("")
    assert cli.run(["reproduce", *arguments.split()]) == 2
    assert capsys.readouterr().err == f"contactgraph: {said}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> list[list[Job]]:
    """Jobs do not run: every JSON file that they would write holds the same numbers."""
    asked: list[list[Job]] = []

    def run_jobs(jobs: Sequence[Job], records: JobRecords, *others: Any) -> list[Failure]:
        asked.append(list(jobs))
        values = {
            **{"success_rate": 1.0, "episodes": 5, "n_step_rmse_planned_m": 0.001},
            "n_step_rmse_planned_moving_m": 0.001,
            "n_step_rmse_planned_moving_by_episode_m": [0.001] * 5,
        }
        for job in jobs:
            path = records.folder / job.output
            if path.suffix == ".json" and "paper-literal" not in job.output:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(json.dumps(values))
        lost = [job for job in jobs if "paper-literal" in job.output]
        failures = [Failure(job, "not started: it needs something", False) for job in lost[1:]]
        first = Failure(lost[0], "exit code 2; contactgraph: no such model")
        report = others[2]
        report(Progress(1, 2, 90.0, lost[0], first))
        return [first, *failures]

    monkeypatch.setattr("contactgraph_studies.runner.run_jobs", run_jobs)
    return asked


def test_files_of_a_study(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    made_up: list[list[Job]],
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as left:
        cli.run(["reproduce", "door", "--quick"])
    assert left.value.code == 1, "a study that lacks something is no success"
    folder = tmp_path / "build" / "quick" / "door"
    assert {path.name for path in folder.iterdir()} - {"cells"} == FILES
    captured = capsys.readouterr()
    assert "1. ours, holds: In distribution, every model's N-step error is" in captured.out
    assert "failed: contactgraph train " in captured.err
    assert "(exit code 2; contactgraph: no such model)" in captured.err
    claims = json.loads((folder / "claims.json").read_text())["claims"]
    found = {(claim["number"], claim["family"]): claim["verdict"] for claim in claims}
    assert found[1, "ours"] == "holds" and found[2, "ours"] == "does not hold"
    assert found[1, "as written"] == "not measured"
    assert all(claim["tasks"] == ["door"] and claim["paper"] for claim in claims)
    results = json.loads((folder / "results.json").read_text())
    assert results["command"] == "contactgraph reproduce door --quick"
    assert results["versions"].keys() >= {"contactgraph", "jax"}
    assert results["training_seeds"] == [0] and results["date"]
    assert results["failures"][0]["reason"] == "exit code 2; contactgraph: no such model"
    assert {job["task"] for job in results["cells"]} == {"door"}
    assert {path.suffix for path in (folder / "figures").iterdir()} == {".png"}
    report = (folder / "report.md").read_text()
    assert report.count("\n> ") == 6, "each claim once, for all families"
    assert "- ours: **holds**. " in report and "Failed measurements" in report


def test_all_tasks_go_into_one_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made_up: list[list[Job]]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("write_study", "publish"):
        monkeypatch.setattr(outputs, name, lambda *arguments: None)
    with pytest.raises(SystemExit):
        cli.run(["reproduce"])
    with pytest.raises(SystemExit):
        cli.run(["reproduce", "all", "--quick", "--out", "other"])
    assert {path.name for path in tmp_path.iterdir()} == {"build", "other"}
    full, quick = ({job.output for job in jobs} for jobs in made_up)
    assert len(quick) < len(full) / 2
    for task in ("pickup", "multi-pickup", "door"):
        assert f"cells/{task}/seed-2/ours-recurrent-40/run" in full - quick
        assert (f"cells/{task}/seed-0/ours-recurrent-40/run" in quick) == (task == "pickup")
    assert quick < full


def test_files_of_the_study_of_costs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learned = replace(own_cost(PICKUP), imitation_loss=jnp.ones(1))
    values = {"success_rate": 0.97, "episodes": 100, "contact_speed_m_s": 1.5}

    def run_jobs(jobs: Sequence[Job], records: JobRecords, *others: Any) -> list[Failure]:
        for job in jobs:
            path = records.folder / job.output
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.name == "cost.json" and "pickup/seed-0" in job.output:
                write_cost(path, learned, {"seconds": 12.5})
            elif path.suffix == ".json" and path.name != "cost.json":
                path.write_text(json.dumps(values))
        return []

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("contactgraph_studies.runner.run_jobs", run_jobs)
    monkeypatch.setattr(config, "COST_TASKS", [PICKUP])
    assert cli.run(["reproduce", "cost", "--quick"]) == 0
    folder = tmp_path / "build" / "quick" / "cost"
    assert {path.name for path in folder.iterdir()} - {"cells"} == FILES
    results = json.loads((folder / "results.json").read_text())
    assert results["command"] == "contactgraph reproduce cost --quick"
    assert (results["demonstrations"], results["test_scene_seeds"]) == ([5, 40], [1100])
    made = [job for job in results["cells"] if job["source"] == "learning"]
    assert {job["values"]["made"]["seconds"] for job in made} == {12.5}
    assert all("history" not in job["values"] and job["values"]["Q"] for job in made)
    figures = {path.name for path in (folder / "figures").iterdir()}
    assert figures == {"cost-pickup.png"}
    report = (folder / "report.md").read_text()
    assert "## A known answer" in report
    assert all(f"](figures/{name})" in report for name in figures)
    known = "| pickup | MPC with the task's own cost | target - goal | 1 m | 70.7 | 70.7 | 1 |"
    assert known in (folder / "table.md").read_text()
