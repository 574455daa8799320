"""A short rehearsal through all of it: server, client, camera, tags, loop, files."""

import json
from pathlib import Path

import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.data import read_trajectories

SEED = 7100
PACE = 12
"""Slow enough for two cores that run other tests, too."""


def told(*arguments: object) -> int:
    return cli.run([str(each) for each in arguments])


def recorded(path: Path) -> dict:
    """One run of 2 s; a run that was stopped is begun anew by the command itself."""
    pytest.importorskip("franky_sim", reason="needs pip install 'contactgraph[rehearsal]'")
    pytest.importorskip("franky", reason="needs pip install 'contactgraph[robot]'")
    numbers = path.with_suffix(".json")
    files = ("--out", path, "--json", numbers)
    options = ("--runs", 1, "--seconds", 2, "--seed", SEED, "--pace", PACE)
    assert told("robot", "rehearse-record", *files, *options) == 0
    return json.loads(numbers.read_text())


def test_a_rehearsed_run_is_recorded_as_it_was(
    tmp_path: Path, server_turn: None, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "runs.h5"
    try:
        numbers = recorded(path)
    except AssertionError:
        said = capfd.readouterr().err
        if "OpenGL" in said:
            pytest.skip(said)
        raise
    (run,), (truth,), (live,) = (
        read_trajectories(path.with_suffix(end)) for end in (".h5", ".truth.h5", ".live.h5")
    )
    assert run.scene.dt == truth.scene.dt == live.scene.dt == 0.001
    assert run.steps == truth.steps == live.steps >= 1000
    # Seen through camera and protocol, everything is where it really is.
    off = np.linalg.norm(run.position - truth.position, axis=2)
    assert np.median(off[:, 1]) < 2e-3 and off[:, 0].max() < 2e-3
    assert numbers["position_error_m"] == pytest.approx(float(np.median(off[:, 1])))
    assert (numbers["runs"], numbers["seed"]) == (1, SEED)
    # What was sent is what moved the hand: as a mass of 4 kg, while nothing of it could touch.
    free = np.linalg.norm(truth.position[:, 1] - truth.position[:, 0], axis=1) > 0.12
    steps = np.array([at for at in range(0, run.steps - 9, 10) if free[at : at + 11].all()])
    force = np.stack([run.control[at : at + 10].mean(axis=0) for at in steps])
    change = np.stack([truth.velocity[at + 10, 0] - truth.velocity[at, 0] for at in steps])
    assert np.sqrt(np.mean((change / 0.01 - force / 4.0) ** 2)) < 0.1
    # The same command has nothing more to do.
    assert told("robot", "rehearse-record", "--out", path, "--runs", 1, "--seed", SEED) == 0
    assert told("robot", "rehearse-record", "--out", path, "--runs", 1, "--seed", 5) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("rehearse-record", "--out", "x.h5", "--runs", "0"), "--runs"),
        (("rehearse-record", "--out", "x.h5", "--seconds", "60"), "--seconds"),
        (("rehearse-record", "--out", "x.h5", "--pace", "0"), "pace must be 0.1 to 100"),
        (("rehearse-record", "--out", "x.h5", "--stopping", "1.5"), "--stopping must be 0 to 1"),
        (("rehearse-control", "franka", "--episodes", "0"), "--episodes"),
        (("rehearse-control", "nobody"), "nobody"),
    ],
)
def test_mistakes_are_told_in_one_line(
    arguments: tuple[str, ...],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("franky_sim", reason="needs pip install 'contactgraph[rehearsal]'")
    monkeypatch.chdir(tmp_path)
    assert told("robot", *arguments) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
