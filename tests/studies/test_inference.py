"""The study of inference: its jobs, and its rows, notes and figure from made-up numbers."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_lines import commands_of, conflicting_outputs, value
from fake_worker import FakeWorker
from test_worlds import finish

from contactgraph.cli import main as cli
from contactgraph_studies.inference_jobs import (
    EXACT,
    FILTER,
    FIRST_FORM,
    HIDDEN,
    INFERENCE_WORLDS,
    KNOWN,
    LATE,
    LYING,
    PRIORS,
    SHIPPED,
    InferenceCondition,
    inference_measurements,
)
from contactgraph_studies.inference_study import InferenceStudy, reliability_figure
from contactgraph_studies.job import Measurement, in_dependency_order
from contactgraph_studies.results import Reading, Results
from contactgraph_studies.study import StudyResult
from contactgraph_studies.worlds import FULL_WORLDS, QUICK_WORLDS

RELEASE, PICKUP, FRANKA = (
    next(world for world in INFERENCE_WORLDS if world.slug == slug)
    for slug in ("release", "pickup", "franka")
)
HALF = [[0, None, None]] * 4 + [[10, 0.45, 0.5], [30, 0.55, 0.6]] + [[0, None, None]] * 4
EVALUATION = {
    "n_step_rmse_m": 0.001,
    "n_step_rmse_inferred_m": 0.001,
    "n_step_rmse_moving_m": 0.01,
    "n_step_rmse_moving_inferred_m": 0.012,
    "constant_velocity_rmse_moving_m": 0.05,
    "frozen_contact_rmse_moving_m": 0.02,
    "edge_f1_now": 0.999,
    "edge_f1_now_inferred": 0.97,
    "calibration_error_inferred": 0.01,
    "calibration_error_ahead_inferred": 0.09,
    "reliability_inferred": HALF,
    "reliability_ahead_inferred": None,
    "told_free_belief": 0.002,
    "told_free_belief_later": 0.004,
    "training_s": 100.0,
}
CONTROL = {"success_rate": 0.95, "episodes": 100, "seed": 2000, "plan_ms_p50": 1.5}
Values = dict[str, Any] | None


def made_up(one: Measurement) -> Values:
    return EVALUATION if one.job.arguments[0] == "evaluate" else CONTROL


def result_of(folder: Path, values: Callable[[Measurement], Values] = made_up) -> StudyResult:
    """Of a folder in which every job has written its values; with None it has not run."""
    worlds = (RELEASE, PICKUP)
    for one in inference_measurements(worlds, FULL_WORLDS):
        answer = values(one)
        if answer is not None:
            finish(folder, in_dependency_order([one.job]))
            (folder / one.job.output).write_text(json.dumps(answer))
    return InferenceStudy(FULL_WORLDS, worlds).result(folder)


def shown(result: StudyResult) -> dict[tuple[str, str], str]:
    """The measured value by number and task."""
    lines = result.tables[0].markdown().split("\n\n")[0].splitlines()[2:]
    cells = [line.strip("| ").split(" | ") for line in lines]
    return {(what, task): measured for what, task, measured in cells}


def test_every_command_line_is_one_of_ours_and_writes_files_of_its_own() -> None:
    outputs = []
    for amounts in (FULL_WORLDS, QUICK_WORLDS):
        jobs = [one.job for one in inference_measurements(INFERENCE_WORLDS, amounts)]
        assert commands_of(jobs) == {"collect", "train", "evaluate", "control"}
        assert conflicting_outputs(jobs) == {}
        outputs.append({job.output for job in in_dependency_order(jobs)})
    assert outputs[0].isdisjoint(outputs[1]), "a quick study leaves the full one alone"


def test_all_jobs_of_the_full_study() -> None:
    found = inference_measurements(INFERENCE_WORLDS, FULL_WORLDS)
    conditions = [one.condition for one in found]
    assert len(conditions) == len({(one.condition, one.seed) for one in found})
    kinds = [job.arguments[0] for job in in_dependency_order(one.job for one in found)]
    assert kinds.count("train") == 3 * (8 + 3) + 4, "the first form cannot learn the switch"
    assert kinds.count("control") == 3 * (1 + 3 + 1)
    for task in HIDDEN:
        of_task = [one for one in conditions if one.task == task and one.model == FILTER.name]
        every = [variant.name for variant in (EXACT, *PRIORS, LYING, LATE)]
        assert [one.measured for one in of_task] == 3 * every
    fitted = [one for one in found if "--baselines" in one.job.arguments]
    assert [(one.condition.task, one.seed) for one in fitted] == [(task, 0) for task in HIDDEN]
    shipped = [one.job for one in found if one.condition.model == SHIPPED.name]
    assert [job.arguments[1] for job in shipped] == [*KNOWN, "franka"]
    assert not any(need.arguments[0] == "train" for job in shipped for need in job.needs)


def test_a_variant_differs_from_the_plain_command_by_its_options_alone() -> None:
    found = inference_measurements([RELEASE], FULL_WORLDS)
    plain = found[0].job
    without = plain.arguments.index("--baselines")
    common = (*plain.arguments[:without], "--infer-contacts", "--json")
    for one in found[2:6]:
        options = next(
            v.options for v in (*PRIORS, LYING, LATE) if v.name == one.condition.measured
        )
        rest = list(one.job.arguments[:-1])
        del rest[without : without + len(options)]
        assert tuple(rest) == common and value(one.job, options[0]) == options[1]
    first = found[1].job.needs[0].arguments
    trained = plain.needs[0].arguments
    assert first[1] == trained[1] and first[-1] == "gim-temp" and trained[-1] == "filter"


def test_cells_by_hand(tmp_path: Path) -> None:
    factor = {variant.name: 1.0 for variant in (EXACT, LYING, LATE)}
    factor |= {PRIORS[0].name: 3.0, PRIORS[1].name: 2.5, LYING.name: 1.2}

    def values(one: Measurement) -> Values:
        if one.job.arguments[0] == "control":
            return CONTROL
        if one.condition.model == FIRST_FORM.name:
            return {**EVALUATION, "n_step_rmse_moving_m": 0.02 + 0.001 * one.seed}
        worst = one.condition.measured == LYING.name and one.seed == 1
        error = 0.01 * (1.0 + one.seed) * (1.05 if worst else factor[one.condition.measured])
        told = 0.3 if (one.condition.task, one.seed) == ("pickup", 2) else 0.002
        return {**EVALUATION, "n_step_rmse_moving_m": error, "told_free_belief": told}

    result = result_of(tmp_path, values)
    rows = shown(result)
    assert rows["error over the floor, contacts measured", "release"] == "1 (0.5 to 1.5)"
    assert rows["error over the floor, by motion alone", "release"] == "0.6 (0.6 to 0.6)"
    prior = "inference replaced by the geometric prior, error over the filter's"
    assert rows[f"{prior}, contacts measured", "release"] == "2.5 (2.5 to 2.5)"
    assert rows[f"{prior}, by motion alone", "release"] == "1 (1 to 1)"
    lying = f"{LYING.name}: error over that of an exact sensor"
    assert rows[lying, "release"] == "1.2 (1.05 to 1.2)"
    told = "told free ten times while touching, belief in contact: next step"
    assert rows[told, "all trainings"] == "0.002 (0.002 to 0.3)"
    assert rows[told, "shipped models"] == "0.002"
    assert rows["error, contacts measured", "pickup"] == "2 cm (1 to 3)"
    f1 = "edge F1 of the step just made"
    assert rows[f"{f1}, by motion alone", "release"] == "0.97 (0.97 to 0.97)"
    assert rows["success", "pickup"] == "95 % (95 to 95)"
    assert rows["control step corrected by motion, 11 objects", "pickup"].startswith("1.5 ms")
    assert result.tables[0].notes == []
    errors = result.tables[1].page_cells()
    assert list(errors["prior-hold"]) == ["5 (2.5 to 7.5)", "-"]
    assert list(errors["first_form"]) == ["2", "2.1 (2 to 2.2)"]


def test_numbers_that_are_missing_have_a_reason(tmp_path: Path) -> None:
    def values(one: Measurement) -> Values:
        late = one.condition.measured == LATE.name
        unknown = {"calibration_error_inferred": None}
        return None if late or one.seed == 2 else {**(made_up(one) or {}), **unknown}

    result = result_of(tmp_path, values)
    rows, notes = shown(result), result.tables[0].notes
    late = f"{LATE.name}: error over that of an exact sensor"
    assert rows[late, "release"] == "-"
    assert f"release: {LATE.name}: not measured yet" in notes
    assert rows["expected calibration error, one step ahead", "release"] == "-"
    assert f"release: {EXACT.name} (1 of 3): not measured yet" in notes
    assert result.tables[0].markdown().count("not measured yet") == len(notes)
    only = InferenceStudy(FULL_WORLDS, (RELEASE,)).result(tmp_path)
    assert not any(row["task"] == "shipped models" for row in only.tables[0].rows)


def test_reliability_adds_up_over_trainings() -> None:
    condition = InferenceCondition("release", FILTER.name, EXACT.name)
    other = [*HALF[:4], [30, 0.41, 0.3], *HALF[5:]]
    readings = [
        Reading(seed, {"reliability_inferred": bins, "reliability_ahead_inferred": None}, "")
        for seed, bins in enumerate((HALF, other, None))
    ]
    figure = reliability_figure(Results({condition: readings}), {"release": "release"})
    diagonal, one_step, ten_steps = figure.axes[0].lines
    np.testing.assert_allclose(one_step.get_xdata(), [(4.5 + 12.3) / 40, 0.55])
    np.testing.assert_allclose(one_step.get_ydata(), [(5.0 + 9.0) / 40, 0.6])
    assert len(ten_steps.get_xdata()) == 0 and len(diagonal.get_xdata()) == 2


def test_the_command_measures_the_chosen_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "values.json").write_text(json.dumps({**EVALUATION, **CONTROL}))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("contactgraph_studies.runner.create_worker", FakeWorker(tmp_path).create)
    study = InferenceStudy(QUICK_WORLDS, (RELEASE, PICKUP))
    monkeypatch.setattr(
        "contactgraph_studies.reproduce._studies", lambda quick: {"inference": study}
    )
    assert cli.run(["reproduce", "inference", "--quick", "--only", "release"]) == 0
    outputs = (tmp_path / "done.txt").read_text().split()
    assert len(outputs) == 2 + 2 + 6
    assert all(output.startswith("cells/quick/release/") for output in outputs)
    folder = tmp_path / "results" / "inference"
    table = (folder / "table.md").read_text()
    assert "| error over the floor, by motion alone | release | 0.6 |" in table
    assert "pickup: control: not measured yet" in table
    assert "worth nothing" in (folder / "index.html").read_text()
    assert (folder / "figures" / "reliability.png").is_file()


@pytest.mark.slow
def test_the_quick_study_of_a_task_runs(tmp_path: Path) -> None:
    command = ["reproduce", "inference", "--quick", "--only", "release", "--out", str(tmp_path)]
    assert cli.run(command) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert len(results["cells"]) == 6 and results["failures"] == []
    assert (
        "| error over the floor, by motion alone | release |" in (tmp_path / "table.md").read_text()
    )
