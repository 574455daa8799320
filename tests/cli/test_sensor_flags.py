"""Flags for contact-sensor faults, and data without contacts, with the shipped model."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import jax
import pytest

from contactgraph.cli import main as cli
from contactgraph.cli.models import stored_model, with_inference
from contactgraph.data import (
    Dataset,
    InvalidInputError,
    read_trajectories,
    strip_contacts,
    write_trajectories,
)
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import SensorFaults, collect
from contactgraph.model import (
    ContactSensor,
    ModelConfig,
    MotionNoise,
    PriorEdges,
    default_sensor,
    hidden_markov_filter,
)


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
    evaluate = ["evaluate", "pickup", str(pickups)]
    for command in (evaluate, control):
        assert cli.run([*command, *flags]) == 130
    assert cli.run([*control, "--unmeasured"]) == 130
    assert [call["faults"] for call in calls] == [
        SensorFaults(0.05, 0.2, 2, 0),
        SensorFaults(0.05, 0.2, 2, 7),
        SensorFaults(seed=7),
    ]
    assert [call.get("measured") for call in calls] == [None, True, False]
    assert cli.run([*evaluate, *flags, "--no-known-rates"]) == 130
    assert [call.get("sensor") for call in calls] == [None, None, None, ContactSensor()]


def test_motion_corrects_beliefs_unless_it_is_ignored(
    pickups: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[dict] = []
    monkeypatch.setattr("contactgraph.evaluate.evaluate_open_loop", interrupting(calls))
    for flags in ([], ["--infer-contacts"], ["--ignore-motion"]):
        assert cli.run(["evaluate", "pickup", str(pickups), *flags]) == 130
    noises = [call["motion_noise"] for call in calls]
    assert noises[0] == noises[1] == MotionNoise() and noises[2] is None


def test_the_geometric_prior_takes_the_place_of_inference(
    pickups: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    models = []

    def called(model: object, *_: object, **__: object) -> None:
        models.append(model)
        raise KeyboardInterrupt

    monkeypatch.setattr("contactgraph.evaluate.evaluate_open_loop", called)
    for name in ("learned", "prior-touch", "prior-hold"):
        assert cli.run(["evaluate", "pickup", str(pickups), "--inference", name]) == 130
    kinds = [type(model.inference).__name__ for model in models]
    assert kinds == ["RecurrentEdges", "PriorEdges", "PriorEdges"]
    # Of two types the only active one holds.
    assert [model.inference.active_type for model in models[1:]] == [1, 1]
    three_types = hidden_markov_filter(ModelConfig(2, 2, 0.05, width=4), key=jax.random.key(0))
    for name, active in (("prior-touch", 1), ("prior-hold", 2)):
        assert with_inference(three_types, name).inference == PriorEdges(3, active)
    with pytest.raises(InvalidInputError, match="--inference must be one of learned, prior-touch"):
        with_inference(three_types, "prior")


def test_evaluate_echoes_the_sensor(fresh: Path, tmp_path: Path) -> None:
    flags = ["--false-alarms", 0.05, "--delay", 2]
    values = metrics_of(["evaluate", "pickup", fresh, *flags], tmp_path / "spoiled.json")
    assert (values["inference"], values["infer_contacts"]) == ("learned", True)
    assert values["edge_f1_now_inferred"] is not None and values["brier_score_inferred"] is not None
    assert [values[name] for name in ("false_alarms", "misses", "delay")] == [0.05, 0, 2]
    assert values["known_rates"] is True
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
    values = metrics_of(["evaluate", "pickup", bare, "--ignore-motion"], tmp_path / "bare.json")
    assert values["edge_f1"] is None and values["edge_accuracy"] is None
    said = capsys.readouterr().out
    assert f"edges were not scored: 1 of 2 trajectories in {bare} have no contact field" in said
    metrics_of(["evaluate", "pickup", pickups, "--ignore-motion"], tmp_path / "full.json")
    assert "not scored" not in capsys.readouterr().out
    assert cli.run(["evaluate", "pickup", str(bare), "--misses", "0.1"]) == 2
    assert "1 of 2 trajectories have no contact field" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--infer-contacts --ignore-motion", "--infer-contacts and --ignore-motion exclude each"),
        ("--misses 1", "--misses must be a share from 0 to below 1, found 1.0"),
        ("--false-alarms nan", "--false-alarms must be a share from 0 to below 1, found nan"),
        ("--delay -1", "--delay must be 0 to 1000, found -1"),
        ("--unmeasured --delay 1", "--unmeasured: no contact is measured"),
    ],
)
def test_invalid_sensor_flags(capsys: pytest.CaptureFixture[str], flags: str, message: str) -> None:
    assert cli.run(["control", "pickup", "pickup", *flags.split()]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("flags", [["--use-contacts"], ["--sensor", "estimate"]])
def test_training_needs_contacts_and_a_filter_for_them(
    flags: list[str], pickups: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare.h5"
    write_trajectories(bare, strip_contacts(read_trajectories(pickups)).trajectories, {})
    for data, model, said in (
        (bare, "filter", "2 of 2 trajectories have no contact field"),
        (pickups, "no-gim", "the model must be a filter (--model filter), found AllEdges"),
    ):
        command = ["train", str(data), "--out", str(tmp_path / "run"), "--held-out", "0.5"]
        assert cli.run([*command, "--model", model, *flags]) == 2
        error = capsys.readouterr().err
        assert said in error and error.startswith(f"contactgraph: {flags[0]}: {data}")
        assert error.count("\n") == 1
        assert not (tmp_path / "run").exists()


def test_the_flags_of_training_are_resumed(
    pickups: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple] = []

    def fit(*arguments: object) -> None:
        calls.append(arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr("contactgraph.train.fit", fit)
    command = ["train", str(pickups), "--out", str(tmp_path / "run")]
    flags = ["--model", "filter", "--use-contacts", "--sensor", "estimate", "--held-out", "0.5"]
    assert cli.run([*command, *flags, "--edge-types", "4"]) == 130
    assert cli.run([*command, "--resume"]) == 130
    assert [call[0].model.inference.edge_types for call in calls] == [4, 4]
    assert [call[3].use_contacts for call in calls] == [True, True]
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (config["use_contacts"], config["sensor"]) == (True, "estimate")


def test_an_estimated_sensor_is_stored_and_used(
    pickups: Path,
    trained: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    sensor = ContactSensor(0.04, 0.06, delay=1)
    monkeypatch.setattr("contactgraph.train.estimate_sensor", lambda model, dataset: sensor)
    monkeypatch.setattr("contactgraph.train.check_contacts", lambda *given: None)
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**config, "sensor": "estimate"}))
    data = config["data"]
    assert cli.run(["train", data, "--out", str(run), "--resume"]) == 0
    said = "reports touch, 1 steps late; false alarms 4 %, misses 6 %"
    assert said in capsys.readouterr().out
    assert default_sensor(stored_model(str(run))) == sensor
