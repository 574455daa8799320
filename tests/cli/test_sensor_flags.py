"""Flags for contact-sensor faults, and data without contacts, with the shipped model."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import contactgraph
from contactgraph.cli import main as cli
from contactgraph.cli.models import stored_model, with_inference
from contactgraph.data import (
    InvalidInputError,
    read_trajectories,
    strip_contacts,
    write_trajectories,
)
from contactgraph.model import (
    HOLD,
    ContactSensor,
    ModelConfig,
    ModelState,
    PriorEdges,
    default_sensor,
    load_model,
    ours,
    scene_nodes,
    shipped_model,
)
from contactgraph.model.motion_likelihood import motion_noise
from contactgraph.policies import SensorFaults


def metrics_of(command: list[object], result: Path) -> dict:
    assert cli.run([str(each) for each in [*command, "--json", result]]) == 0
    return json.loads(result.read_text())


LEARNED = "that of the model"
CLOSED_LOOP = "contactgraph.policies.task_policy"
OPEN_LOOP = "contactgraph.evaluate.evaluate_open_loop"
FAULTS = "--false-alarms 0.05 --misses 0.2 --delay 2"


@pytest.mark.parametrize(
    ("command", "flags", "given"),
    [
        ("evaluate", "", {"faults": SensorFaults(), "motion_noise": LEARNED}),
        ("evaluate", "--ignore-motion", {"motion_noise": None}),
        ("evaluate", FAULTS, {"faults": SensorFaults(0.05, 0.2, 2, 0)}),
        ("control", FAULTS, {"faults": SensorFaults(0.05, 0.2, 2, 7), "measured": True}),
        ("control", "--unmeasured", {"faults": SensorFaults(seed=7), "measured": False}),
    ],
)
def test_the_flags_are_passed_on(
    fresh: Path, interrupted: Callable, command: str, flags: str, given: dict
) -> None:
    evaluates = command == "evaluate"
    calls = interrupted(OPEN_LOOP if evaluates else CLOSED_LOOP)
    what = [str(fresh)] if evaluates else ["pickup", "--seed", "7"]
    assert cli.run([command, "pickup", *what, *flags.split()]) == 130
    (call,) = calls
    for name, expected in given.items():
        if expected == LEARNED:
            expected = motion_noise(load_model(shipped_model("pickup")).model)
        assert eqx.tree_equal(call.options[name], expected), name


def test_the_geometric_prior_takes_the_place_of_inference(
    fresh: Path, interrupted: Callable
) -> None:
    calls = interrupted(OPEN_LOOP)
    controlled = interrupted(CLOSED_LOOP)
    for name in ("filter", "prior-touch", "prior-hold", "none"):
        assert cli.run(["evaluate", "pickup", str(fresh), "--inference", name]) == 130
        assert cli.run(["control", "pickup", "pickup", "--inference", name]) == 130
    for models in ([call.arguments[0] for call in made] for made in (calls, controlled)):
        kinds = [type(model.inference).__name__ for model in models]
        assert kinds == ["DurationEdges", "PriorEdges", "PriorEdges", "PriorEdges"]
        assert [model.inference.active_type for model in models[1:]] == [1, 2, 0]
    two_types = ours(ModelConfig(2, 2, 0.05, width=4, edge_types=(HOLD,)), key=jax.random.key(0))
    for name in ("prior-touch", "prior-hold"):  # the only active type holds
        assert with_inference(two_types, name).inference == PriorEdges((HOLD,), 1)
    with pytest.raises(InvalidInputError, match="--inference must be one of filter, prior-touch"):
        with_inference(two_types, "prior")


def test_without_edges_no_contact_is_predicted() -> None:
    model = with_inference(stored_model("pickup"), "none")
    task = contactgraph.make("pickup")
    observation, _ = task.reset(seed=0)
    position = observation["position"]
    position = jnp.asarray(position[0] + np.array([[0.0, 0.0], [0.08, 0.0]]))
    nodes, still = scene_nodes(task.scene), jnp.zeros((2, 2))
    start = ModelState(position, still, model.initial_belief(position, still, nodes))
    rolled = model.rollout(start, jnp.tile(jnp.array([5.0, 0.0]), (4, 1)), nodes)
    assert np.max(rolled.belief.probability) < 1e-6
    assert np.allclose(rolled.position[:, 1], position[1], atol=1e-6)


def test_evaluate_echoes_the_sensor(fresh: Path, tmp_path: Path) -> None:
    flags = ["--false-alarms", 0.05, "--delay", 2, "--ignore-motion"]
    values = metrics_of(["evaluate", "pickup", fresh, *flags], tmp_path / "spoiled.json")
    assert (values["inference"], values["infer_contacts"]) == ("filter", False)
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


@pytest.fixture(scope="module")
def bare(fresh: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two pickups, of which one was recorded without contacts."""
    path = tmp_path_factory.mktemp("bare") / "bare.h5"
    dataset = read_trajectories(fresh)
    without = strip_contacts(dataset).trajectories[1]
    write_trajectories(path, [dataset.trajectories[0], without], dataset.metadata)
    return path


def test_edges_without_truth_are_not_scored(
    fresh: Path, bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = metrics_of(["evaluate", "pickup", bare, "--ignore-motion"], tmp_path / "bare.json")
    assert values["edge_f1"] is None and values["edge_accuracy"] is None
    said = capsys.readouterr().out
    assert f"edges were not scored: 1 of 2 trajectories in {bare} have no contact field" in said
    metrics_of(["evaluate", "pickup", fresh, "--ignore-motion"], tmp_path / "full.json")
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
def test_invalid_sensor_flags(mistake: Callable, flags: str, message: str) -> None:
    assert mistake("control", "pickup", "pickup", *flags.split()).startswith(message)


@pytest.mark.parametrize("flags", [["--use-contacts"], ["--sensor", "estimate"]])
def test_training_needs_contacts_and_a_filter_for_them(
    flags: list[str], fresh: Path, bare: Path, mistake: Callable
) -> None:
    for data, model, said in (
        (bare, "ours", "1 of 2 trajectories have no contact field"),
        (fresh, "ours-no-inference", "the model must be a filter (--model ours), found PriorEdges"),
    ):
        command = ["train", data, "--out", "run", "--held-out", 0.5, "--model", model]
        error = mistake(*command, *flags)
        assert said in error and error.startswith(f"{flags[0]}: {data}")


def test_an_estimated_sensor_is_stored_and_used(
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
    assert cli.run(["train", config["data"], "--out", str(run), "--resume"]) == 0
    said = "reports touch, 1 steps late; false alarms 4 %, misses 6 %"
    assert said in capsys.readouterr().out
    assert default_sensor(stored_model(str(run))) == sensor
