"""The study of worlds: its jobs, table, notes and figure from made-up numbers."""

import csv
import io
import json
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from command_lines import commands_of, conflicting_outputs, value
from fake_worker import FakeWorker

from contactgraph.cli import main as cli
from contactgraph.cli.known_tasks import TASKS
from contactgraph_studies.job import Job, JobRecords, Measurement, in_dependency_order
from contactgraph_studies.paper.config import DOOR, QUICK
from contactgraph_studies.paper.study import ModelStudy
from contactgraph_studies.study import StudyResult
from contactgraph_studies.world_row import ERRORS
from contactgraph_studies.world_study import WorldStudy, world_figure
from contactgraph_studies.worlds import (
    FULL_WORLDS,
    QUICK_WORLDS,
    WORLDS,
    Source,
    World,
    WorldAmounts,
    world_measurements,
)

EVALUATION = {
    "n_step_rmse_m": 0.001,
    "n_step_rmse_moving_m": 0.002,
    "n_step_rmse_inferred_m": 0.002,
    "n_step_rmse_moving_inferred_m": 0.004,
    "constant_velocity_rmse_moving_m": 0.05,
    "standing_still_rmse_moving_m": 0.08,
    "frozen_contact_rmse_moving_m": 0.03,
    "least_squares_rmse_moving_m": 0.02,
    "gnn_rmse_moving_m": 0.01,
    "edge_f1_now": 0.99,
    "edge_f1_now_inferred": 0.9,
    "verdict": "better than all",
}
CONTROL = {"success_rate": 0.95, "episodes": 20, "seed": 2000}
AMOUNTS = WorldAmounts((0, 1, 2), 60, 40, 20, 100, "cells")
PICKUP = World("pickup", "pickup", scenes=TASKS["pickup"].conditions[:1], fast_control=True)
WATCHED = World("watched", "pickup", ("--distractors", "1"), controlled=False)
ABSENT = World("absent", "absent", extra="pusht", packages=("no_such_module",))

Values = dict[str, Any] | None


def made_up(one: Measurement) -> Values:
    return EVALUATION if one.condition.source is Source.open_loop else CONTROL


def finish(folder: Path, jobs: Sequence[Job], seconds: float = 61.0) -> None:
    records = JobRecords(folder, version("contactgraph"))
    for job in jobs:
        (folder / job.output).parent.mkdir(parents=True, exist_ok=True)
        (folder / job.output).touch()
        records.finish(job, seconds)


def result_of(
    folder: Path,
    worlds: Sequence[World] = (PICKUP,),
    values: Callable[[Measurement], Values] = made_up,
    amounts: WorldAmounts = AMOUNTS,
) -> StudyResult:
    """Of a folder in which every job has written its values; with None it has not run."""
    for one in world_measurements([each for each in worlds if each.missing is None], amounts):
        answer = values(one)
        if answer is not None:
            finish(folder, in_dependency_order([one.job]))
            (folder / one.job.output).write_text(json.dumps(answer))
    return WorldStudy(amounts, worlds).result(folder)


def shown(result: StudyResult) -> dict[str, list[str]]:
    """The texts of the cells by name of the row, without the name."""
    lines = result.tables[0].markdown().split("\n\n")[0].splitlines()[2:]
    cells = [line.strip("| ").split(" | ") for line in lines]
    return {name: rest for name, *rest in cells}


def test_every_command_line_is_one_of_ours_and_writes_files_of_its_own() -> None:
    for amounts in (FULL_WORLDS, QUICK_WORLDS):
        jobs = [one.job for one in world_measurements(WORLDS, amounts)]
        assert commands_of(jobs) == {"collect", "train", "evaluate", "control"}
        assert conflicting_outputs(jobs) == {}


def test_all_jobs_of_the_full_study(monkeypatch: pytest.MonkeyPatch) -> None:
    # Tasks whose package is missing would be left out.
    monkeypatch.setattr("contactgraph_studies.worlds.find_spec", lambda name: name)
    jobs = WorldStudy(FULL_WORLDS).jobs
    kinds = [job.arguments[0] for job in jobs]
    assert kinds.count("train") == 3 * 14, "every world but the one with a shipped model"
    assert kinds.count("evaluate") == 3 * 17 + 1
    tests = [job for job in jobs if "/test-" in job.output]
    assert len(tests) == 18 and {value(job, "--seed") for job in tests} == {"1000"}
    training = [job for job in jobs if job.output.endswith("train.h5")]
    assert {value(job, "--seed") for job in training} == {"0", "1", "2"}
    scenes = [job for job in jobs if job.arguments[0] == "control"]
    assert {value(job, "--seed") for job in scenes} == {"2000"}
    fast = {"pickup", "multi-pickup", "door"}
    assert all((value(job, "--episodes") == "100") == (job.arguments[2] in fast) for job in scenes)


def test_all_controllers_of_a_row_get_the_same_scenes_and_all_trainings_the_same_data() -> None:
    found = world_measurements([WORLDS[0]], FULL_WORLDS)
    for scenes in WORLDS[0].scenes:
        here = [one for one in found if one.condition.scenes == scenes.slug]
        closed = [one.job.arguments for one in here if one.job.arguments[0] == "control"]
        options = {arguments[2 : arguments.index("--json")] for arguments in closed}
        assert options == {("pickup", *scenes.options, "--episodes", "100", "--seed", "2000")}
        evaluated = [one.job for one in here if one.condition.source is Source.open_loop]
        assert len({job.arguments[2] for job in evaluated}) == 1
        for job in evaluated:
            training, data, _ = job.needs
            assert value(job, "--baselines") == data.output == training.arguments[1]
            assert value(training, "--seed") == value(data, "--seed")


def test_test_data_are_recorded_as_the_training_data_are() -> None:
    mixed = World("mixed", "pickup", ("--distractors", "2"), ("--exploration", "0.5"))
    jobs = in_dependency_order(one.job for one in world_measurements([mixed], QUICK_WORLDS))
    recorded = [job.arguments for job in jobs if job.arguments[0] == "collect"]
    shared = ("collect", "pickup", "--distractors", "2", "--exploration", "0.5")
    assert [arguments[:6] for arguments in recorded] == [shared, shared]
    assert {arguments[7] for arguments in recorded} == {"12", "3"}
    controlled = [job.arguments for job in jobs if job.arguments[0] == "control"]
    assert all(each[2:5] == ("pickup", "--distractors", "2") for each in controlled)
    assert not any("--exploration" in each for each in controlled)


def test_a_quick_study_leaves_the_files_of_the_full_one_alone() -> None:
    full, quick = (
        {job.output for job in WorldStudy(each).jobs} for each in (FULL_WORLDS, QUICK_WORLDS)
    )
    assert full.isdisjoint(quick)


def test_cells_by_hand(tmp_path: Path) -> None:
    def values(one: Measurement) -> Values:
        error, rate = (0.002, 0.001, 0.004)[one.seed % 5], (1.0, 0.97, 0.5)[one.seed % 5]
        if one.condition.source is Source.open_loop:
            return {**EVALUATION, "n_step_rmse_moving_m": error}
        if one.condition.source is Source.mpc:
            return {"success_rate": rate, "episodes": 100, "seed": 2000}
        return CONTROL

    result = result_of(tmp_path, values=values)
    assert shown(result)["pickup"] == [
        *("**0.2 (0.1 to 0.4)**", "0.4", "5", "8", "3", "2", "1", "better than all"),
        *("0.9", "0.99", "100, 97, 50 % of the same 100 (median: 91.5 to 99)"),
        *("95 % of 20 (76.4 to 99.1)", "-", "61"),
    ]
    assert result.tables[0].notes == ["pickup: fixed start: the task has none"]
    row = next(csv.DictReader(io.StringIO(result.tables[0].csv())))
    assert (row["row"], row["trainings"], row["episodes_mpc"]) == ("pickup", "3", "100")
    assert [row[f"measured_cm_{end}"] for end in ("median", "low", "high")] == ["0.2", "0.1", "0.4"]
    assert (row["percent_of_each_seed_mpc"], row["successes_scripted"]) == ("100 97 50", "19")
    assert row["command_open_loop"].startswith("contactgraph evaluate cells/pickup/seed-0/run ")
    assert row["command_mpc"].startswith("contactgraph control cells/pickup/seed-0/run pickup ")


@pytest.mark.parametrize(
    ("changed", "bold"),
    [
        ({}, ["**0.2**"]),
        # A baseline that learns is bold where it is better; one that does not learn never is.
        ({"gnn_rmse_moving_m": 0.001}, ["**0.1**"]),
        ({"constant_velocity_rmse_moving_m": 0.001}, ["**0.2**"]),
        ({"least_squares_rmse_moving_m": 0.002}, ["**0.2**", "**0.2**"]),
        ({"n_step_rmse_m": None, "n_step_rmse_moving_m": None}, ["**0.4**"]),
    ],
)
def test_the_smallest_learned_error_is_bold(
    tmp_path: Path, changed: dict[str, Any], bold: list[str]
) -> None:
    result = result_of(tmp_path, values=lambda one: {**(made_up(one) or {}), **changed})
    assert [cell for cell in shown(result)["pickup"] if "**" in cell] == bold
    assert result.tables[0].html().count("<b>") == len(bold)


@pytest.mark.parametrize(
    ("changed", "verdict"),
    [
        ({}, "better than all"),
        ({"frozen_contact_rmse_moving_m": 0.001}, "better than all; behind frozen contact"),
        (
            {"verdict": "no better", "n_step_rmse_moving_m": 0.06},
            "no better; behind constant velocity, least squares, the interaction network and "
            "frozen contact",
        ),
        (
            {"n_step_rmse_moving_inferred_m": 0.015},
            "better than all; by motion alone behind the interaction network",
        ),
    ],
)
def test_the_verdict_names_every_baseline_that_is_better(
    tmp_path: Path, changed: dict[str, Any], verdict: str
) -> None:
    if "n_step_rmse_moving_m" in changed:
        changed = {**changed, "n_step_rmse_moving_inferred_m": 0.06}
    result = result_of(tmp_path, values=lambda one: {**(made_up(one) or {}), **changed})
    assert shown(result)["pickup"][7] == verdict


def test_verdicts_of_trainings_that_differ_are_counted(tmp_path: Path) -> None:
    said = ("better than constant velocity", "better than all", "better than constant velocity")

    def values(one: Measurement) -> Values:
        opened = one.condition.source is Source.open_loop
        return {**EVALUATION, "verdict": said[one.seed]} if opened else CONTROL

    verdict = shown(result_of(tmp_path, values=values))["pickup"][7]
    assert verdict == "better than all (1), better than constant velocity (2)"


def test_empty_cells_have_a_reason(tmp_path: Path) -> None:
    names = ("frozen_contact", "least_squares", "gnn")
    unknown: dict[str, Any] = {f"{name}_rmse_moving_m": None for name in names}
    unknown |= {"edge_f1_now": None, "least_squares_missing": "other numbers of bodies"}

    def values(one: Measurement) -> Values:
        return None if one.seed == 1 else {**EVALUATION, **unknown}

    result = result_of(tmp_path, [WATCHED, ABSENT], values)
    label = "pickup --distractors 1"
    assert shown(result) == {
        label: [
            *("**0.2**", "0.4", "5", "8", "-", "-", "-", "better than all", "0.9", "-"),
            *("-", "-", "-", "61"),
        ],
        "absent": ["-"] * 14,
    }
    assert result.tables[0].notes == [
        f"{label}: errors and edges (training 1): not measured yet",
        f"{label}: frozen contact (oracle): the data lack masses, contacts or forces",
        f"{label}: least squares: other numbers of bodies",
        f"{label}: interaction network: its prediction is not finite",
        f"{label}: edge F1, measured: no edge is labelled or believed active",
        f"{label}: success: nothing is controlled",
        "absent: all: absent needs another package: pip install 'contactgraph[pusht]'",
    ]
    markdown, html = result.tables[0].markdown(), result.tables[0].html()
    assert markdown.endswith("[pusht]'\n") and html.count("<li>") == 7


def test_a_diverged_error_is_not_finite_and_an_unknown_one_a_dash(tmp_path: Path) -> None:
    def values(one: Measurement) -> Values:
        diverged = {"n_step_rmse_m": None, "n_step_rmse_moving_m": None}
        return {**EVALUATION, **diverged, "n_step_rmse_moving_inferred_m": None}

    cells = shown(result_of(tmp_path, [WATCHED], values))["pickup --distractors 1"]
    assert cells[:2] == ["not finite", "-"]


def test_numbers_of_other_commands_are_not_shown(tmp_path: Path) -> None:
    result_of(tmp_path, [WATCHED])
    more = WorldAmounts((0, 1, 2), 61, 40, 20, 100, "cells")
    result = WorldStudy(more, [WATCHED]).result(tmp_path)
    assert set(shown(result)["pickup --distractors 1"]) == {"-"}
    assert result.tables[0].notes == ["pickup --distractors 1: all: not measured yet"]
    assert result.readings == []


def test_a_dot_for_each_training_and_one_for_each_baseline(tmp_path: Path) -> None:
    def values(one: Measurement) -> Values:
        opened = one.condition.source is Source.open_loop
        return {**EVALUATION, "gnn_rmse_moving_m": None} if opened else CONTROL

    result_of(tmp_path, [PICKUP, WATCHED], values)
    study = WorldStudy(AMOUNTS, [PICKUP, WATCHED, ABSENT])
    axes = world_figure(study.rows(tmp_path)).axes[0]
    counts = {line.get_label(): len(line.get_xdata()) for line in axes.lines}
    assert [text.get_text() for text in axes.get_yticklabels()][2] == "absent"
    assert axes.get_xscale() == "log" and len(counts) == len(ERRORS)
    assert counts["ours, contacts measured"] == counts["ours, by motion alone"] == 6
    assert counts["least squares"] == 2 and counts["interaction network"] == 0
    empty = world_figure(WorldStudy(AMOUNTS, [ABSENT]).rows(tmp_path))
    assert empty.axes[0].get_xscale() == "linear", "an empty logarithmic axis is an error"


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a study of two worlds, whose commands only pretend to work."""
    (tmp_path / "values.json").write_text(json.dumps({**EVALUATION, **CONTROL}))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("contactgraph_studies.runner.create_worker", FakeWorker(tmp_path).create)
    study = WorldStudy(QUICK_WORLDS, (PICKUP, WATCHED, ABSENT))
    studies = {"worlds": study, "door": ModelStudy((DOOR,), QUICK)}
    monkeypatch.setattr("contactgraph_studies.reproduce._studies", lambda quick: studies)
    return tmp_path


def done(folder: Path) -> list[str]:
    """Outputs of the commands since the last call."""
    path = folder / "done.txt"
    lines = path.read_text().splitlines() if path.exists() else []
    path.unlink(missing_ok=True)
    return lines


def test_rows_are_made_one_after_the_other_and_only_once(
    fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["reproduce", "worlds", "--quick", "--only"]
    assert cli.run([*command, "watched"]) == 0
    assert "left out: absent needs another package" in capsys.readouterr().err
    cells = "cells/quick/watched"
    outputs = (
        "seed-0/train.h5",
        "seed-0/run",
        "test-as-trained.h5",
        "seed-0/evaluate-as-trained.json",
    )
    assert sorted(done(fake)) == sorted(f"{cells}/{output}" for output in outputs)
    folder = fake / "results" / "worlds"
    table = (folder / "table.md").read_text()
    assert "| pickup --distractors 1 | **0.2** |" in table
    assert "- pickup: all: not measured yet" in table
    assert cli.run([*command, "pickup"]) == 0
    assert not [output for output in done(fake) if "watched" in output]
    table = (folder / "table.md").read_text()
    assert "| pickup | **0.2** |" in table and "| pickup --distractors 1 | **0.2** |" in table
    assert cli.run([*command, "pickup, watched"]) == 0
    assert done(fake) == [], "a second run runs nothing"
    page = (folder / "index.html").read_text()
    assert "worth nothing" in page and "<svg" not in page and "data:image/svg+xml" in page
    results = json.loads((folder / "results.json").read_text())
    assert results["command"] == "contactgraph reproduce worlds --quick --only 'pickup, watched'"
    assert {cell["world"] for cell in results["cells"]} == {"pickup", "watched"}
    assert (folder / "figures" / "errors.png").is_file()


def test_a_failed_job_leaves_its_row_with_a_reason(
    fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (fake / "fails.txt").write_text("cells/quick/pickup/seed-0/run")
    with pytest.raises(SystemExit) as left:
        cli.run(["reproduce", "worlds", "--quick"])
    assert left.value.code == 1
    assert "contactgraph: it cannot be" in capsys.readouterr().err
    text = (fake / "results" / "worlds" / "table.md").read_text()
    dashes = " | ".join("-" * 11)
    assert f"| pickup | {dashes} | 95 % of 20 (76.4 to 99.1) | - | - |" in text
    assert "| pickup --distractors 1 | **0.2** |" in text
    training = "contactgraph train cells/quick/pickup/seed-0/train.h5"
    lost = "errors and edges (training 0) and success of MPC (training 0)"
    assert (
        f"pickup: {lost}: not finished: {training}" in text
        and "(contactgraph: it cannot be)" in text
    )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            "worlds --only pickup,chess",
            "--only must be one of pickup, watched, absent; found 'chess'",
        ),
        (
            "worlds --only absent",
            "--only: absent needs another package: pip install 'contactgraph[pusht]'",
        ),
        ("door --only pickup", "--only: the study must be worlds or inference, found door"),
    ],
)
def test_mistakes(
    fake: Path, capsys: pytest.CaptureFixture[str], arguments: str, said: str
) -> None:
    assert cli.run(["reproduce", *arguments.split()]) == 2
    assert capsys.readouterr().err == f"contactgraph: {said}\n"
    assert not (fake / "results").exists()


def test_a_missing_package_is_noticed_without_importing_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fetch = next(world for world in WORLDS if world.slug == "fetch-push")
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    assert fetch.missing == "fetch-push needs another package: pip install 'contactgraph[fetch]'"
    left = WorldStudy(FULL_WORLDS).left_out
    assert [reason.split()[0] for reason in left] == [
        *("fetch-push", "fetch-slide", "fetch-pick-and-place")
    ]


@pytest.mark.slow
def test_real_rows(tmp_path: Path) -> None:
    """Rows with and without measured contact and with and without control, by our own commands."""
    command = ["reproduce", "worlds", "--quick", "--out", str(tmp_path)]
    assert cli.run([*command, "--only", "suction,billiards-passive"]) == 0
    with (tmp_path / "table.csv").open() as file:
        rows = {row["world"]: row for row in csv.DictReader(file)}
    for slug in ("suction", "billiards-passive"):
        for name in ("measured_cm", "constant_velocity_cm", "standing_still_cm", "gnn_cm"):
            assert float(rows[slug][f"{name}_median"]) > 0.0, (slug, name)
    assert rows["suction"]["episodes_mpc"] == rows["suction"]["episodes_scripted"] == "2"
    assert rows["billiards-passive"]["episodes_mpc"] == ""
    table = (tmp_path / "table.md").read_text()
    assert "- billiards --passive: success: nothing is controlled" in table
    assert "- pickup, as trained: all: not measured yet" in table
