"""``contactgraph reproduce --check``: stored numbers against new ones."""

import json
import random
from collections.abc import Sequence
from pathlib import Path

import pytest

from contactgraph.cli import main as cli
from contactgraph_studies.job import Job, JobRecords
from contactgraph_studies.runner import Failure

ERRORS = "n_step_rmse_planned_moving_by_episode_m"


@pytest.fixture
def numbers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, object]:
    """Jobs do not run: they write these numbers. A study of door made of them is stored."""
    written: dict[str, object] = {
        ERRORS: [0.01, 0.02, 0.03],
        "n_step_rmse_moving_by_run_m": [0.01, 0.02, 0.03],
        **{"success_by_episode": [True, False, True], "edge_accuracy": 0.9},
        **{"success_rate": 2 / 3, "episodes": 3, "n_step_rmse_planned_m": 0.01},
        "n_step_rmse_planned_moving_m": 0.01,
    }

    def run_jobs(jobs: Sequence[Job], records: JobRecords, *_: object) -> list[Failure]:
        for job in jobs:
            path = records.folder / job.output
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.suffix == ".json":
                path.write_text(json.dumps(written))
        return []

    monkeypatch.setattr("contactgraph_studies.runner.run_jobs", run_jobs)
    monkeypatch.chdir(tmp_path)
    assert cli.run(["reproduce", "door", "--quick"]) in (0, None)
    return written


def checked(count: int, capsys: pytest.CaptureFixture[str]) -> tuple[int, list[str]]:
    """The exit code and the lines printed."""
    capsys.readouterr()
    random.seed(0)  # of the draw: which of the numbers that did not change are among them
    code = 0
    try:
        code = cli.run(["reproduce", "door", "--quick", "--check", str(count)]) or 0
    except SystemExit as left:
        code = int(str(left.code))
    return code, capsys.readouterr().out.splitlines()


def test_equal_numbers_agree(
    numbers: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in Path("results").rglob("*.json")}
    code, lines = checked(4, capsys)
    assert code == 0 and lines[-1] == "4 of 4 agree" and len(lines) == 5
    assert all(line.startswith("door, ") and line.endswith(": agrees") for line in lines[:-1])
    assert before == {path: path.stat().st_mtime_ns for path in Path("results").rglob("*.json")}


def test_others_differ(numbers: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    numbers |= {ERRORS: [0.04] * 3, "n_step_rmse_moving_by_run_m": None}
    numbers |= {"success_by_episode": [False] * 3, "edge_accuracy": 0.91}
    code, lines = checked(9, capsys)
    assert code == 1 and lines[-1] in ("0 of 9 agree", "1 of 9 agree", "2 of 9 agree")
    assert sum("DIFFERS" in line for line in lines) >= 7


def test_what_fails_is_no_agreement(
    numbers: dict[str, object],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    numbers |= {ERRORS: None, "n_step_rmse_moving_by_run_m": None, "success_by_episode": None}
    assert checked(9, capsys)[1][-1] != "9 of 9 agree", "they were known"
    monkeypatch.setattr("contactgraph_studies.runner.run_jobs", lambda *_: [])
    code, lines = checked(9, capsys)
    assert code == 1 and lines[-1] == "0 of 9 agree"
    assert all("again not measured: DIFFERS" in line for line in lines[:-1])
