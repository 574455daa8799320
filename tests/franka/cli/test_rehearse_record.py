"""A recording on the simulated robot: server, client, camera, tags, loop and files together."""

import json
from pathlib import Path

import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.data import read_trajectories

SEED = 7100
PACE = 12
"""Slow enough for two cores that run other tests too."""


def run(*arguments: object) -> int:
    return cli.run(["robot", "rehearse-record", *(str(each) for each in arguments)])


@pytest.mark.slow
@pytest.mark.realtime
def test_recording_agrees_with_the_ground_truth(
    tmp_path: Path, server_turn: None, capfd: pytest.CaptureFixture[str]
) -> None:
    """One trajectory of 2 s; the command repeats an episode that was stopped."""
    pytest.importorskip("franky_sim", reason="needs pip install 'contactgraph[rehearsal]'")
    pytest.importorskip("franky", reason="needs pip install 'contactgraph[robot]'")
    path, report = tmp_path / "runs.h5", tmp_path / "runs.json"
    options = ("--runs", 1, "--seconds", 2, "--seed", SEED, "--pace", PACE)
    code, error = run("--out", path, "--json", report, *options), capfd.readouterr().err
    if code and "OpenGL" in error:
        pytest.skip(error)
    assert code == 0, error
    numbers = json.loads(report.read_text())
    (recorded,), (truth,), (live,) = (
        read_trajectories(path.with_suffix(end)) for end in (".h5", ".truth.h5", ".live.h5")
    )
    assert recorded.scene.dt == truth.scene.dt == live.scene.dt == 0.001
    assert recorded.steps == truth.steps == live.steps >= 1000
    # Camera and protocol give the true positions.
    off = np.linalg.norm(recorded.position - truth.position, axis=2)
    assert np.median(off[:, 1]) < 2e-3 and off[:, 0].max() < 2e-3
    assert numbers["position_error_m"] == pytest.approx(float(np.median(off[:, 1])))
    assert (numbers["runs"], numbers["seed"]) == (1, SEED)
    # The sent force moves the hand as a mass of 4 kg, while nothing of it is in contact.
    free = np.linalg.norm(truth.position[:, 1] - truth.position[:, 0], axis=1) > 0.12
    steps = np.array([at for at in range(0, recorded.steps - 9, 10) if free[at : at + 11].all()])
    force = np.stack([recorded.control[at : at + 10].mean(axis=0) for at in steps])
    change = np.stack([truth.velocity[at + 10, 0] - truth.velocity[at, 0] for at in steps])
    assert np.sqrt(np.mean((change / 0.01 - force / 4.0) ** 2)) < 0.1
    # The same command has nothing left to do.
    assert run("--out", path, "--runs", 1, "--seed", SEED) == 0
    assert run("--out", path, "--runs", 1, "--seed", 5) == 2
