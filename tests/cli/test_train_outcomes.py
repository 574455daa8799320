"""Ends of a training by the command: printed errors, warnings, and exit codes; `fit` is made up."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.data import Trajectory, read_trajectories, write_trajectories
from contactgraph.train import FitProgress, FitResult, FitStatus, HeldOutBaselines, TrainConfig

BASELINES = HeldOutBaselines(0.375, 0.5, moving=True)


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Makes the next training end with a status and an error, after two checks."""

    def end(status: FitStatus, error: float, baselines: HeldOutBaselines = BASELINES) -> None:
        def fit(state, train, held_out, config, on_check, devices):
            for step, held_out_error in ((1, 2.0 * error), (2, error), (3, 3.0 * error)):
                best = min(2.0 * error if step == 1 else error, held_out_error)
                state = replace(state, step=jnp.asarray(step), best_error=jnp.asarray(best))
                on_check(FitProgress(step, 3, {}, held_out_error, 7.0, state, baselines))
            return FitResult(state.best_model, error, status, state, 8.6, baselines)

        monkeypatch.setattr("contactgraph.train.fit", fit)

    return end


def trained(recorded: Path, tmp_path: Path) -> int:
    options = ["--model", "gim-temp", "--steps", "3"]
    return cli.run(["train", str(recorded), "--out", str(tmp_path / "run"), *options])


def test_errors_stand_beside_their_baselines(
    recorded: Path, tmp_path: Path, ends: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    ends(FitStatus.finished, 0.125)
    assert trained(recorded, tmp_path) == 0
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
    assert said[1] == ("trained for 9 s, compilation included; contact distance 0.085 m, learned")


@pytest.mark.parametrize(
    ("options", "model", "inference", "steps"),
    [
        ([], "filter", "TransitionEdges", 750),
        (["--model", "gim-temp"], "gim-temp", "RecurrentEdges", 2000),
    ],
)
def test_the_default_model_for_forces_is_the_filter_and_steps_depend_on_the_model(
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    model: str,
    inference: str,
    steps: int,
) -> None:
    given = []

    def fit(state, train, held_out, config, on_check, devices):
        given.append((type(state.model.inference).__name__, config.steps))
        raise KeyboardInterrupt

    monkeypatch.setattr("contactgraph.train.fit", fit)
    run = tmp_path / "run"
    assert cli.run(["train", str(recorded), "--out", str(run), *options]) == 130
    assert cli.run(["train", str(recorded), "--out", str(run), "--resume"]) == 130
    assert given == [(inference, steps)] * 2
    assert steps % TrainConfig().check_every == 0, "a shorter last round is compiled once more"
    config = json.loads((run / "config.json").read_text())
    assert (config["model"], config["steps"]) == (model, steps)


@pytest.mark.parametrize("error", [0.375, 0.4, 0.6])
def test_a_model_that_is_no_better_than_constant_velocity_is_named(
    recorded: Path,
    tmp_path: Path,
    ends: Callable,
    capsys: pytest.CaptureFixture[str],
    error: float,
) -> None:
    ends(FitStatus.finished, error)
    assert trained(recorded, tmp_path) == 0
    (warning,) = (line for line in capsys.readouterr().err.splitlines() if "warning" in line)
    assert "the model is no better than constant velocity or standing still" in warning


def test_held_out_data_in_which_nothing_moves_are_named(
    recorded: Path, tmp_path: Path, ends: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    ends(FitStatus.finished, 0.125, replace(BASELINES, moving=False))
    assert trained(recorded, tmp_path) == 0
    captured = capsys.readouterr()
    assert "standing still 50.000, all bodies" in captured.out
    (warning,) = (line for line in captured.err.splitlines() if "warning" in line)
    assert "no body moves more than 1 mm in the held-out windows" in warning


@pytest.mark.parametrize("status", [FitStatus.dead_units, FitStatus.constant_velocity])
def test_a_dead_network_is_neither_success_nor_the_users_mistake(
    recorded: Path,
    tmp_path: Path,
    ends: Callable,
    capsys: pytest.CaptureFixture[str],
    status: FitStatus,
) -> None:
    ends(status, 0.375)
    assert trained(recorded, tmp_path) == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert line == (
        f"contactgraph: {tmp_path / 'run'}: {status.value}; try another --seed, a lower "
        "--learning-rate, more data or another --model"
    )


@pytest.mark.parametrize(("error", "better"), [(0.374, True), (0.3749, False), (0.6, False)])
def test_a_model_of_use_is_better_than_both_baselines(error: float, better: bool) -> None:
    state = None
    for baselines in (BASELINES, HeldOutBaselines(0.5, 0.375, moving=True)):
        result = FitResult(state, error, FitStatus.finished, state, 0.0, baselines)
        assert result.is_better is better


@pytest.mark.parametrize(("options", "turns"), [([], True), (["--no-turns"], False)])
def test_bodies_turn_unless_told_otherwise(
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    turns: bool,
) -> None:
    def turning(each: Trajectory) -> Trajectory:
        count = each.scene.node_count
        square = np.array([[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]])
        scene = replace(each.scene, polygons=(square,) * count, polygon_of=np.arange(count))
        angle = np.tile(each.scene.dt * np.arange(each.steps + 1)[:, None, None], (1, count, 1))
        rate = np.ones_like(angle)
        return replace(each, scene=scene, orientation=angle, angular_velocity=rate)

    data = tmp_path / "turning.h5"
    write_trajectories(data, map(turning, read_trajectories(recorded)))
    given = []

    def fit(state, train, held_out, config, on_check, devices):
        given.append(state.model.features.turn_length is not None)
        raise KeyboardInterrupt

    monkeypatch.setattr("contactgraph.train.fit", fit)
    run = tmp_path / "run"
    assert cli.run(["train", str(data), "--out", str(run), "--model", "bodies", *options]) == 130
    assert cli.run(["train", str(data), "--out", str(run), "--resume"]) == 130
    assert given == [turns, turns]
