"""``contactgraph evaluate`` with another horizon, and with baselines fitted to training data."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from contactgraph.cli import main as cli
from contactgraph.evaluate.baselines import standing_still
from contactgraph.model import shipped_model
from contactgraph.model.io import describe_model


class Unmoved:
    """Stands in for a fitted network."""

    seconds, steps = 24.04, 150

    def __call__(self, trajectory, steps):
        return standing_still(trajectory, steps)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The times, s, that training of a network was asked to take; nothing is trained."""
    seconds: list[float] = []

    def fit(dataset, time, least_steps):
        assert least_steps == 750
        seconds.append(time)
        return Unmoved()

    monkeypatch.setattr("contactgraph.evaluate.network_fit.fit_interaction_network", fit)
    return seconds


def test_the_network_is_trained_for_as_long_as_the_model(
    fresh: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: list[float]
) -> None:
    path = tmp_path / "out.json"
    arguments = ["evaluate", "pickup", str(fresh), "--baselines", str(fresh), "--ignore-motion"]
    assert cli.run([*arguments, "--json", str(path)]) == 0
    took = describe_model(shipped_model("pickup")).training["training_s"]
    assert asked == [took] and took > 1.0
    values = json.loads(path.read_text())
    assert (values["gnn_training_s"], values["gnn_training_steps"]) == (24.0, 150)
    assert values["gnn_rmse_moving_m"] == values["standing_still_rmse_moving_m"]
    assert values["least_squares_missing"] is None
    assert 0.0 < values["least_squares_rmse_moving_m"] < values["constant_velocity_rmse_moving_m"]
    lines = capsys.readouterr().out.splitlines()
    training = "interaction network: 150 steps of training in 24 s"
    assert f"{training}, at least the model's 750 in {took:.0f} s" in lines
    for text, name in (("least squares", "least_squares"), ("interaction network ", "gnn")):
        (line,) = (each for each in lines if each.startswith(text) and each.endswith("cm"))
        assert f"{100 * values[f'{name}_rmse_moving_m']:.3f} cm" in line


def test_a_wrong_horizon_is_told_before_anything_is_fitted(
    fresh: Path, mistake: Callable, asked: list[float]
) -> None:
    for horizon in ("0.12", "nan"):
        said = mistake("evaluate", "pickup", fresh, "--baselines", fresh, "--horizon", horizon)
        assert said.startswith("the horizon must be a multiple of the time step, 0.05 s, up to 10")
    assert asked == []


def test_another_horizon(fresh: Path, interrupted: Callable) -> None:
    calls = interrupted("contactgraph.evaluate.evaluate_open_loop")
    for options in ([], ["--horizon", "0.1"]):
        assert cli.run(["evaluate", "pickup", str(fresh), *options]) == 130
    assert [call.options["horizon_s"] for call in calls] == [None, 0.1]


def test_a_prediction_of_ones_own_stands_beside_the_others(
    fresh: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    mistake: Callable,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path, module = tmp_path / "out.json", "contactgraph.evaluate.baselines"
    command = ["evaluate", "pickup", str(fresh), "--ignore-motion", "--prediction"]
    assert cli.run([*command, f"{module}:constant_rates", "--json", str(path)]) == 0
    values = json.loads(path.read_text())
    error = values["constant_rates_rmse_moving_m"]
    assert error == values["constant_velocity_rmse_moving_m"] > 0.0
    lines = capsys.readouterr().out.splitlines()
    (line,) = (each for each in lines if each.startswith("constant_rates "))
    assert f"{100 * error:.3f} cm" in line
    said = mistake(*command, f"{module}:standing_still")
    assert said.startswith("predictions must have new names, found 'standing_still'")
    monkeypatch.chdir(tmp_path)
    Path("network_of_mine.py").write_text("def gnn(trajectory, steps):\n    return None\n")
    said = mistake(*command, "network_of_mine:gnn")
    assert said.startswith("predictions must have new names, found 'gnn'")
