"""Ends of a training by the command: printed errors, warnings, and exit codes; `fit` is made up."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.data import Trajectory, read_trajectories, write_trajectories
from contactgraph.identify import identify, in_units
from contactgraph.model import PRESETS, describe_model
from contactgraph.train import FitProgress, FitResult, FitStatus, HeldOutBaselines

BASELINES = HeldOutBaselines(0.375, 0.5, moving=True)


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Makes the next training end with a status and an error, after two checks."""

    def end(status: FitStatus, error: float, baselines: HeldOutBaselines = BASELINES) -> None:
        def fit(state, train, held_out, config, on_check, devices, near_pairs):
            for step, held_out_error in ((1, 2.0 * error), (2, error), (3, 3.0 * error)):
                best = min(2.0 * error if step == 1 else error, held_out_error)
                state = replace(state, step=jnp.asarray(step), best_error=jnp.asarray(best))
                on_check(FitProgress(step, 3, {}, held_out_error, 7.0, state, baselines))
            return FitResult(state.best_model, error, status, state, 8.6, baselines)

        monkeypatch.setattr("contactgraph.train.fit", fit)

    return end


@pytest.fixture
def train(recorded: Path, tmp_path: Path) -> Callable[..., int]:
    """Trains with these options in a folder, and answers the exit code."""

    def command(*options: str, data: Path = recorded, out: str = "run") -> int:
        return cli.run(["train", str(data), "--out", str(tmp_path / out), *options])

    return command


SHORT = ("--model", "ours-recurrent", "--steps", "3")


def test_errors_stand_beside_their_baselines(
    train: Callable, ends: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    ends(FitStatus.finished, 0.125)
    assert train(*SHORT) == 0
    captured = capsys.readouterr()
    baselines = "constant velocity 37.500, standing still 50.000, moving bodies"
    checks = [line for line in captured.err.splitlines() if "training: " in line]
    assert checks == [
        f"training: 1 of 3 held-out error 25.000 cm (best 25.000), {baselines}",
        f"training: 2 of 3 held-out error 12.500 cm (best 12.500), {baselines}",
        f"training: 3 of 3 held-out error 37.500 cm (best 12.500), {baselines}",
    ]
    assert "warning" not in captured.err
    said = captured.out.splitlines()[-2:]
    assert said[0].endswith(
        f"model.safetensors: held-out error 12.500 cm, {baselines} over 8 steps; all steps done"
    )
    assert said[1] == ("trained for 9 s, compilation included; contact distance 0.07983 m, given")


@pytest.mark.parametrize(
    ("flags", "parts", "written"),
    [
        ("", ("DurationEdges", "SpringMassDamperDynamics"), {"model": "ours", "steps": 750}),
        (
            "--model ours-memoryless",
            ("MemorylessEdges", "SpringMassDamperDynamics"),
            {"model": "ours-memoryless", "steps": 2000},
        ),
        (
            "--model ours-full-ab",
            ("RecurrentEdges", "FreeLinearDynamics"),
            {"model": "ours-full-ab", "steps": 2000},
        ),
        (
            "--use-contacts --sensor estimate --edge-types 4",
            ("DurationEdges", "SpringMassDamperDynamics"),
            {"use_contacts": True, "sensor": "estimate", "edge_types": 4},
        ),
    ],
)
def test_a_training_interrupted_before_its_first_step_is_resumed_with_its_options(
    train: Callable,
    tmp_path: Path,
    interrupted: Callable,
    flags: str,
    parts: tuple[str, str],
    written: dict,
) -> None:
    """Without flags a filter is trained, and the number of steps depends on the model."""
    calls, run = interrupted("contactgraph.train.fit"), tmp_path / "run"
    assert train(*flags.split()) == 130
    assert [path.name for path in run.glob("checkpoint-*")] == ["checkpoint-0000000000.safetensors"]
    assert train("--resume") == 130
    config = json.loads((run / "config.json").read_text())
    assert {name: config[name] for name in written} == written
    assert len(calls) == 2
    for call in calls:
        state, _, _, recipe = call.arguments[:4]
        model = state.model
        assert (type(model.inference).__name__, type(model.local_dynamics).__name__) == parts
        assert recipe.steps == config["steps"] and recipe.use_contacts == config["use_contacts"]
        assert recipe.steps % recipe.check_every == 0, "a shorter last round is compiled once more"
        assert written.get("edge_types") in (None, 1 + len(model.inference.edge_types))


def test_the_command_trains_what_a_user_gets_in_python(
    recorded: Path, train: Callable, ends: Callable, interrupted: Callable, tmp_path: Path
) -> None:
    dataset = read_trajectories(recorded)
    facts = identify(dataset)
    ends(FitStatus.finished, 0.125)
    assert train(*SHORT) == 0
    stored = describe_model(tmp_path / "run" / "model.safetensors").config
    assert eqx.tree_equal(asdict(stored), asdict(facts.in_data))
    calls = interrupted("contactgraph.train.fit")
    assert train(*SHORT, out="other") == 130
    state, train_part, held_out, config = calls[0].arguments[:4]
    fresh = PRESETS["ours-recurrent"](facts.config, key=jax.random.key(0))
    assert eqx.tree_equal(state.model, fresh)
    assert config.rollout_from == facts.rollout_from
    own = in_units(dataset, facts.units)
    control = np.concatenate([each.control for each in (*train_part, *held_out)])
    expected = np.concatenate([each.control for each in own])
    assert np.array_equal(np.sort(control, axis=0), np.sort(expected, axis=0))


@pytest.mark.parametrize(
    ("error", "moving", "warns"),
    [
        (0.375, True, "the model is no better than constant velocity or standing still"),
        (0.125, False, "no body moves more than 1 mm in the held-out windows"),
    ],
)
def test_an_error_that_says_little_is_named(
    train: Callable,
    ends: Callable,
    capsys: pytest.CaptureFixture[str],
    error: float,
    moving: bool,
    warns: str,
) -> None:
    ends(FitStatus.finished, error, replace(BASELINES, moving=moving))
    assert train(*SHORT) == 0
    said, errors = capsys.readouterr()
    assert f"standing still 50.000, {'moving' if moving else 'all'} bodies" in said
    (warning,) = (line for line in errors.splitlines() if "warning" in line)
    assert warns in warning


@pytest.mark.parametrize("status", [FitStatus.dead_units, FitStatus.constant_velocity])
def test_a_dead_network_is_neither_success_nor_the_users_mistake(
    train: Callable,
    tmp_path: Path,
    ends: Callable,
    capsys: pytest.CaptureFixture[str],
    status: FitStatus,
) -> None:
    ends(status, 0.375)
    assert train(*SHORT) == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith(f"contactgraph: {tmp_path / 'run'}: {status.value}; try another --seed")


@pytest.mark.parametrize(("error", "better"), [(0.374, True), (0.3749, False), (0.6, False)])
def test_a_model_of_use_is_better_than_both_baselines(error: float, better: bool) -> None:
    state = None
    for baselines in (BASELINES, HeldOutBaselines(0.5, 0.375, moving=True)):
        result = FitResult(state, error, FitStatus.finished, state, 0.0, baselines)
        assert result.is_better is better


def test_bodies_turn_unless_told_otherwise(
    recorded: Path, train: Callable, tmp_path: Path, interrupted: Callable
) -> None:
    def turning(each: Trajectory) -> Trajectory:
        count = each.scene.node_count
        square = np.array([[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]])
        scene = replace(each.scene, polygons=(square,) * count, polygon_of=np.arange(count))
        angle = np.tile(each.scene.dt * np.arange(each.steps + 1)[:, None, None], (1, count, 1))
        rate = np.ones_like(angle)
        return replace(each, scene=scene, orientation=angle, angular_velocity=rate)

    data = tmp_path / "turning.h5"
    write_trajectories(data, map(turning, read_trajectories(recorded).trajectories[:4]))
    calls = interrupted("contactgraph.train.fit")
    assert train(data=data, out="turning") == 130
    for flags in (("--no-turns",), ("--resume",)):
        assert train(*flags, data=data) == 130
    lengths = [call.arguments[0].model.features.turn_length for call in calls]
    assert [length is not None for length in lengths] == [True, False, False]
