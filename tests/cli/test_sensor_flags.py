"""Flags for contact-sensor faults, and data without contacts, with the shipped model."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from contactgraph.cli import main as cli
from contactgraph.data import Dataset, read_trajectories, strip_contacts, write_trajectories
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import SensorFaults, collect


@pytest.fixture(scope="module")
def pickups(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "pickups.h5"
    write_trajectories(path, collect([PickupTask], [PickupExpert()], 2, 0), {"task": "pickup"})
    return path


def metrics_of(command: list[object], result: Path) -> dict:
    assert cli.run([str(each) for each in [*command, "--json", result]]) == 0
    return json.loads(result.read_text())


def interrupting(calls: list[dict]) -> Callable:
    """Replaces long work: stores the arguments, and stops."""

    def called(*arguments: object, **options: object) -> None:
        calls.append(options)
        raise KeyboardInterrupt

    return called


def test_the_flags_are_passed_on(pickups: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[dict] = []
    monkeypatch.setattr("contactgraph.evaluate.evaluate_open_loop", interrupting(calls))
    monkeypatch.setattr("contactgraph.evaluate.control_task", interrupting(calls))
    flags = ["--false-alarms", "0.05", "--misses", "0.2", "--delay", "2"]
    control = ["control", "pickup", "pickup", "--seed", "7"]
    for command in (["evaluate", "pickup", str(pickups)], control):
        assert cli.run([*command, *flags]) == 130
    assert cli.run([*control, "--unmeasured"]) == 130
    assert [call["faults"] for call in calls] == [
        SensorFaults(0.05, 0.2, 2, 0),
        SensorFaults(0.05, 0.2, 2, 7),
        SensorFaults(seed=7),
    ]
    assert [call.get("measured") for call in calls] == [None, True, False]


def test_evaluate_echoes_the_sensor(fresh: Path, tmp_path: Path) -> None:
    flags = ["--false-alarms", 0.05, "--delay", 2]
    values = metrics_of(["evaluate", "pickup", fresh, *flags], tmp_path / "spoiled.json")
    assert [values[name] for name in ("false_alarms", "misses", "delay")] == [0.05, 0, 2]
    assert values["edge_f1"] is not None


@pytest.mark.slow
def test_control_reports_the_sensor_and_the_plans(tmp_path: Path) -> None:
    command = ["control", "pickup", "pickup", "--episodes", 1, "--replan-every", 10]
    values = metrics_of([*command, "--misses", 0.1], tmp_path / "one.json")
    assert (values["misses"], values["unmeasured"], values["replan_every"]) == (0.1, False, 10)
    assert values["planned_windows"] == 20
    assert values["n_step_rmse_planned_m"] < values["constant_velocity_planned_rmse_m"]
    assert 0 <= values["edge_accuracy_planned"] <= 1


def test_edges_without_truth_are_not_scored(
    pickups: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare.h5"
    dataset = read_trajectories(pickups)
    mixed = Dataset((dataset.trajectories[0], strip_contacts(dataset).trajectories[1]))
    write_trajectories(bare, list(mixed), mixed.metadata)
    values = metrics_of(["evaluate", "pickup", bare], tmp_path / "bare.json")
    assert values["edge_f1"] is None and values["edge_accuracy"] is None
    said = capsys.readouterr().out
    assert f"edges were not scored: 1 of 2 trajectories in {bare} have no contact field" in said
    metrics_of(["evaluate", "pickup", pickups], tmp_path / "full.json")
    assert "not scored" not in capsys.readouterr().out
    assert cli.run(["evaluate", "pickup", str(bare), "--misses", "0.1"]) == 2
    assert "1 of 2 trajectories have no contact field" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--misses 1", "--misses must be a share from 0 to below 1, found 1.0"),
        ("--false-alarms nan", "--false-alarms must be a share from 0 to below 1, found nan"),
        ("--delay -1", "--delay must be 0 to 1000, found -1"),
        ("--unmeasured --delay 1", "--unmeasured: no contact is measured"),
    ],
)
def test_invalid_sensor_flags(capsys: pytest.CaptureFixture[str], flags: str, message: str) -> None:
    assert cli.run(["control", "pickup", "pickup", *flags.split()]) == 2
    assert message in capsys.readouterr().err
