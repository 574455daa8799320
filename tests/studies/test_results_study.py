"""The study of results: its table and notes from made-up numbers, and its gate."""

import csv
import io
import json
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from fake_worker import FakeWorker, Here, done

from contactgraph.cli import main as cli
from contactgraph_studies import gate
from contactgraph_studies.data_sets import (
    FULL,
    GATE,
    QUICK,
    Amounts,
    DataSet,
    Source,
    result_measurements,
)
from contactgraph_studies.job import JobRecords, Measurement, in_dependency_order
from contactgraph_studies.paper import config
from contactgraph_studies.paper.study import ModelStudy
from contactgraph_studies.results_study import QUANTITIES, ResultsStudy
from contactgraph_studies.study import StudyResult

EVALUATION: dict[str, Any] = {
    **{quantity.key: None for _, quantity in QUANTITIES.values()},
    "n_step_rmse_m": 0.001,
    "n_step_rmse_moving_m": 0.002,
    "n_step_rmse_inferred_m": 0.002,
    "n_step_rmse_moving_inferred_m": 0.004,
    "constant_velocity_rmse_moving_m": 0.05,
    "least_squares_rmse_moving_m": 0.02,
    "gnn_rmse_moving_m": 0.01,
    "edge_f1_now": 0.99,
    "edge_f1_now_inferred": 0.9,
    "calibration_error_inferred": 0.03,
    "training_s": 61.0,
}
CONTROL = {
    **{"success_rate": 0.95, "episodes": 20, "seed": 2000, "goal_distance_m_median": 0.001},
    **{"plan_ms_p50": 1.5, "plan_ms_p99": 4.0},
}
AMOUNTS = Amounts((0, 1, 2), 60, 40, 100, 20, baselines=True)
PICKUP = DataSet("pickup")
PASSIVE = DataSet("billiards", ("--passive",))
ABSENT = DataSet("fetch-push", extra="fetch")

Values = dict[str, Any] | None


@pytest.fixture(autouse=True)
def _packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every package is installed, but for those of Fetch."""
    found = {"gym_pusht", "mujoco"}
    monkeypatch.setattr("contactgraph_studies.data_sets.find_spec", found.intersection)
    monkeypatch.setattr(
        "contactgraph_studies.data_sets._MODULES",
        {"pusht": (["gym_pusht"],), "mujoco": (["mujoco"],), "fetch": (["gymnasium_robotics"],)},
    )


def made_up(one: Measurement) -> Values:
    return EVALUATION if one.job.arguments[0] == "evaluate" else CONTROL


def result_of(
    folder: Path,
    sets: Sequence[DataSet] = (PICKUP,),
    values: Callable[[Measurement], Values] = made_up,
    amounts: Amounts = AMOUNTS,
) -> StudyResult:
    """Of a folder in which every job has written its values; with None it has not run."""
    records = JobRecords(folder, version("contactgraph"))
    for one in result_measurements([each for each in sets if each.missing is None], amounts):
        answer = values(one)
        if answer is not None:
            for job in in_dependency_order([one.job]):
                (folder / job.output).parent.mkdir(parents=True, exist_ok=True)
                (folder / job.output).touch()
                records.finish(job, 61.0)
            (folder / one.job.output).write_text(json.dumps(answer))
    return ResultsStudy(amounts, sets).result(folder)


def shown(result: StudyResult) -> dict[str, list[str]]:
    """The texts of the cells by name of the row, without the name."""
    lines = result.tables[0].markdown().split("\n\n")[0].splitlines()[2:]
    cells = [line.strip("| ").split(" | ") for line in lines]
    return {name: rest for name, *rest in cells}


def test_cells_by_hand(tmp_path: Path) -> None:
    def values(one: Measurement) -> Values:
        error, rate = (0.002, 0.001, 0.004)[one.seed % 5], (1.0, 0.97, 0.5)[one.seed % 5]
        if one.condition.source is Source.model:
            return {**EVALUATION, "n_step_rmse_moving_m": error, "angle_rmse_rad": 0.1}
        if one.condition.source is Source.mpc:
            return {**CONTROL, "success_rate": rate, "episodes": 100}
        return made_up(one)

    result = result_of(tmp_path, values=values)
    assert shown(result)["pickup"] == [
        *("**0.2 (0.1 to 0.4)**", "0.4", "5", "2", "1", "5.73", "0.9", "0.03"),
        *("100, 97, 50 % of the same 100 (median: 91.5 to 99)", "95 % of 20 (76.4 to 99.1)"),
        *("-", "1.5", "61"),
    ]
    row = next(csv.DictReader(io.StringIO(result.tables[0].csv())))
    assert (row["row"], row["trainings"], row["episodes_mpc"]) == ("pickup", "3", "100")
    assert [row[f"measured_cm_{end}"] for end in ("median", "low", "high")] == ["0.2", "0.1", "0.4"]
    assert (row["percent_of_each_seed_mpc"], row["successes_expert"]) == ("100 97 50", "19")
    for name in ("collect", "train", "evaluate", "control"):
        assert row[f"command_{name}"].startswith(f"contactgraph {name} pickup")
    kept = {key for one in result.readings for key in one["values"]}
    assert "training_s" in kept and kept <= {q.key for _, q in QUANTITIES.values()} | {
        *("n_step_rmse_m", "n_step_rmse_inferred_m", "episodes", "seed"),
    }
    of = {each["source"]: each["values"].keys() for each in result.readings}
    assert "n_step_rmse_moving_m" in of["model"] and "n_step_rmse_moving_m" not in of["mpc"]


def test_the_smallest_learned_error_is_bold_and_hidden_holds_are_measured_under_forces(
    tmp_path: Path,
) -> None:
    data = DataSet("release", hidden=True)
    errors = {Source.forced: 0.003, Source.forced_prior_hold: 0.001, Source.prior_touch: 0.002}

    def values(one: Measurement) -> Values:
        answer, error = made_up(one), errors.get(one.condition.source)
        if error is None or answer is None:
            return answer
        return {**answer, "n_step_rmse_moving_inferred_m": error}

    result = result_of(tmp_path, [data], values)
    assert shown(result)["release"][:5] == ["**0.2**", "0.4", "5", "2", "1"]
    row = next(csv.DictReader(io.StringIO(result.tables[0].csv())))
    names = ("forced_cm", "forced_prior_hold_cm", "prior_touch_cm", "prior_hold_success_percent")
    assert [row[f"{name}_median"] for name in names] == ["0.3", "0.1", "0.2", "95.0"]


def test_empty_cells_have_a_reason(tmp_path: Path) -> None:
    def values(one: Measurement) -> Values:
        lost = {"least_squares_missing": "other numbers of bodies"}
        diverged = {"n_step_rmse_m": None, "n_step_rmse_moving_m": None}
        unknown = {"least_squares_rmse_moving_m": None, **lost, **diverged}
        return None if one.seed == 1 else {**EVALUATION, **unknown}

    result = result_of(tmp_path, [PASSIVE, ABSENT], values)
    label = "billiards --passive"
    assert shown(result)[label][:6] == ["not finite", "**0.4**", "5", "-", "1", "-"]
    assert set(shown(result)["fetch-push"]) == {"-"}
    assert result.tables[0].notes == [
        f"{label}: model 1: not measured yet",
        f"{label}: least squares: other numbers of bodies",
        f"{label}: success: nothing is controlled",
        "fetch-push: all: fetch-push needs another package: pip install 'contactgraph[fetch]'",
    ]


def test_a_model_that_motion_tells_nothing_has_no_error_by_motion(tmp_path: Path) -> None:
    unknown = {"n_step_rmse_moving_inferred_m": None, "n_step_rmse_inferred_m": None}
    for judged, text in ((True, "not finite"), (False, "-")):
        found = {**EVALUATION, **unknown, "infer_contacts": judged}
        result = result_of(tmp_path / text, [PASSIVE], lambda one, found=found: found)
        assert shown(result)["billiards --passive"][1] == text


def test_numbers_of_other_commands_are_not_shown(tmp_path: Path) -> None:
    result_of(tmp_path, [PASSIVE])
    more = Amounts((0, 1, 2), 61, 40, 20, 20, baselines=True)
    result = ResultsStudy(more, [PASSIVE]).result(tmp_path)
    assert set(shown(result)["billiards --passive"]) == {"-"} and result.readings == []


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a study of two data sets, whose commands only pretend to work."""
    (tmp_path / "values.json").write_text(json.dumps({**EVALUATION, **CONTROL}))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("contactgraph_studies.runner.create_worker", FakeWorker(tmp_path).create)
    monkeypatch.setattr("contactgraph.cli.options.open_executor", lambda _: nullcontext(Here()))

    def studies(quick: bool, gate: bool) -> dict[str, Any]:
        amounts = QUICK if quick else GATE if gate else FULL
        return {
            "results": ResultsStudy(amounts, (PICKUP, PASSIVE, ABSENT)),
            "door": ModelStudy((config.DOOR,), config.QUICK),
        }

    monkeypatch.setattr("contactgraph_studies.reproduce._studies", studies)
    return tmp_path


def test_rows_are_made_one_after_the_other_and_only_once(
    fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["reproduce", "results", "--quick", "--only"]
    assert cli.run([*command, "billiards"]) == 0
    assert "left out: fetch-push needs another package" in capsys.readouterr().err
    outputs = ("train.h5", "seed-0/run", "test-as-trained.h5", "seed-0/evaluate-as-trained.json")
    fitted = "seed-0/evaluate-as-trained-baselines.json"
    assert sorted(done(fake)) == sorted(f"billiards/{output}" for output in (*outputs, fitted))
    folder = fake / "build" / "quick" / "results"
    assert "- pickup: " in (folder / "table.md").read_text()
    assert cli.run([*command, "pickup"]) == 0
    assert not [output for output in done(fake) if "billiards" in output]
    table = (folder / "table.md").read_text()
    assert "| pickup | **0.2** |" in table and "| billiards --passive | **0.2** |" in table
    assert cli.run([*command, "pickup, billiards"]) == 0
    assert done(fake) == [], "a second run runs nothing"
    assert "worth nothing" in (folder / "report.md").read_text()
    results = json.loads((folder / "results.json").read_text())
    assert results["command"] == (
        "contactgraph reproduce results --quick --only 'pickup, billiards'"
    )
    assert not (fake / "results").exists(), "a quick study publishes nothing"


def test_a_study_is_published_and_goes_on_from_what_is_kept(fake: Path) -> None:
    command = ["reproduce", "results", "--only", "pickup", "--seeds", "1"]
    assert cli.run(command) == 0
    tables = fake / "results" / "tables"
    names = {"results.csv", "results.md", "results.json"}
    assert {path.name for path in tables.iterdir()} == names
    assert done(fake)
    (fake / "build").rename(fake / "lost")
    assert cli.run([*command, "--resume"]) == 0
    assert done(fake) == [], "nothing is measured twice"
    kept = (fake / "lost" / "results" / "table.md").read_text()
    assert (tables / "results.md").read_text() == kept
    (fake / "build").rename(fake / "lost too")
    assert cli.run(["reproduce", "results", "--only", "billiards", "--seeds", "1"]) == 0
    assert done(fake) and not [output for output in done(fake) if "pickup" in output]
    table = (tables / "results.md").read_text()
    assert "| pickup | **0.2** |" in table and "| billiards --passive | **0.2** |" in table
    (fake / "build").rename(fake / "lost as well")
    assert cli.run([*command, "--resume"]) == 0
    assert (tables / "results.md").read_text() == table, "published numbers of both are kept"
    (fake / "build").rename(fake / "lost again")
    elsewhere = ["--out", str(fake / "build" / "results")]
    assert cli.run(["reproduce", "results", "--only", "billiards", "--seeds", "1", *elsewhere]) == 0
    assert cli.run(["reproduce", "results", "--only", "billiards", "--seeds", "1"]) == 0
    assert (tables / "results.md").read_text() == table, "though a run there knew nothing of pickup"


def test_a_failed_job_leaves_its_row_with_a_reason(
    fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (fake / "fails.txt").write_text("pickup/seed-0/run")
    with pytest.raises(SystemExit) as left:
        cli.run(["reproduce", "results", "--quick"])
    assert left.value.code == 1
    assert "contactgraph: it cannot be" in capsys.readouterr().err
    text = (fake / "build" / "quick" / "results" / "table.md").read_text()
    assert "| billiards --passive | **0.2** |" in text
    lost = "pickup: model 0, baselines, mpc 0: not finished: contactgraph train pickup/train.h5"
    assert lost in text and "(contactgraph: it cannot be)" in text


def test_the_gate_names_what_is_worse(fake: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["reproduce", "results", "--gate"]
    assert cli.run(command) == 0
    first = next((fake / "build" / "gate").glob("*/gate.json"))
    assert str(first.relative_to(fake)) in capsys.readouterr().out
    assert cli.run([*command, "--against", str(first)]) == 0
    assert "nothing is worse" in capsys.readouterr().out
    before = json.loads(first.read_text())
    assert before["numbers"]["pickup"]["measured_cm"] == pytest.approx(0.2)
    before["numbers"]["pickup"] |= {"measured_cm": 0.15, "edge_f1_motion": 0.5, "goal_cm": 0.0999}
    before["numbers"]["door"] = {"training_s": 10.0}
    (fake / "before.json").write_text(json.dumps(before))
    with pytest.raises(SystemExit) as left:
        cli.run([*command, "--against", "before.json"])
    assert left.value.code == 1
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "pickup: measured_cm: 0.15 before, 0.2 now (noise 0.015)",
        "door: training_s: 10 before, not measured now",
    ]
    # The range over three trainings counts as noise where it is larger.
    table = fake / "results" / "tables" / "results.csv"
    table.parent.mkdir(parents=True)
    table.write_text("row,measured_cm_low,measured_cm_high\npickup,0.1,0.2\n")
    del before["numbers"]["door"]
    (fake / "before.json").write_text(json.dumps(before))
    assert cli.run([*command, "--against", "before.json"]) == 0


def test_a_gate_measures_its_own_state_and_only_what_it_is_asked_for(
    fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["reproduce", "results", "--seeds", "1"]) == 0
    done(fake)
    only = ["reproduce", "results", "--gate", "--only", "pickup"]
    assert cli.run([*only, "--resume"]) == 0
    made = done(fake)
    assert "pickup/seed-0/evaluate-as-trained.json" in made, "kept numbers are of another state"
    assert not [output for output in made if "billiards" in output]
    found = json.loads(next((fake / "build" / "gate").glob("*/gate.json")).read_text())
    assert found["numbers"].keys() == {"pickup"}
    found["numbers"]["billiards --passive"] = {"measured_cm": 0.2}
    (fake / "before.json").write_text(json.dumps(found))
    assert cli.run([*only, "--against", "before.json"]) == 0
    assert "nothing is worse" in capsys.readouterr().out


def test_noise_of_successes_is_that_of_their_numbers_of_scenes() -> None:
    def found(before: float, after: float, episodes: int) -> list[str]:
        states = [
            {"numbers": {"pickup": {"success_percent": rate}}, "episodes": {"pickup": episodes}}
            for rate in (before, after)
        ]
        return [str(one) for one in gate.compare(states[0], states[1], {})]

    assert found(100.0, 80.0, 20) and not found(100.0, 90.0, 20) and found(100.0, 90.0, 200)
    assert not found(80.0, 100.0, 20)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            "results --only pickup,chess",
            "--only must be one of pickup, billiards, fetch-push; found 'chess'",
        ),
        (
            "results --only fetch-push",
            "--only: fetch-push needs another package: pip install 'contactgraph[fetch]'",
        ),
        ("door --only pickup", "--only: the study must be results, found door"),
        ("door --gate", "--gate: the study must be results, found door"),
        (
            "results --gate --quick",
            "--gate: not with --quick, whose numbers are worth nothing",
        ),
        ("results --seeds 0", "--seeds must be 1 to 100, found 0"),
        ("results --against old.json", "--against: only with --gate"),
        ("results --gate --against no.json", "--against: no.json: No such file or directory"),
        ("results --gate --against text.json", "--against: text.json is no JSON file"),
        (
            "results --gate --against other.json",
            "--against: other.json must be a file of reproduce results --gate",
        ),
        (
            "results --gate --against broken.json",
            "--against: broken.json must be a file of reproduce results --gate",
        ),
        (
            "results --gate --against old.json",
            "--against: old.json has version 0 of the gate's file, this program compares version "
            "1: measure that state again",
        ),
    ],
)
def test_mistakes(
    fake: Path, capsys: pytest.CaptureFixture[str], arguments: str, said: str
) -> None:
    (fake / "text.json").write_text("gate")
    (fake / "other.json").write_text("[]")
    (fake / "broken.json").write_text('{"gate": 1, "numbers": {"pickup": 3}}')
    (fake / "old.json").write_text('{"gate": 0, "numbers": {}}')
    assert cli.run(["reproduce", *arguments.split()]) == 2
    assert capsys.readouterr().err == f"contactgraph: {said}\n"
    assert not (fake / "results").exists() and not (fake / "build").exists()


def test_a_missing_package_is_noticed_without_importing_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    left = ResultsStudy(FULL).left_out
    assert [reason.split()[0] for reason in left] == ["fetch-push", "fetch-pick-and-place"]


@pytest.mark.slow
def test_real_rows(tmp_path: Path) -> None:
    """Rows with and without priors and control, by our own commands."""
    command = ["reproduce", "results", "--quick", "--out", str(tmp_path)]
    assert cli.run([*command, "--only", "release,billiards"]) == 0
    with (tmp_path / "table.csv").open() as file:
        rows = {row["data"]: row for row in csv.DictReader(file)}
    for slug in ("release", "billiards"):
        for name in ("measured_cm", "motion_cm", "constant_velocity_cm", "network_cm"):
            assert float(rows[slug][f"{name}_median"]) > 0.0, (slug, name)
    assert rows["release"]["episodes_mpc"] == rows["release"]["episodes_expert"] == "2"
    assert float(rows["release"]["prior_hold_cm_median"]) > 0.0
    assert rows["billiards"]["episodes_mpc"] == ""
    assert "- door: " in (tmp_path / "table.md").read_text()
