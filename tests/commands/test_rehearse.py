"""A short rehearsal through all of it: server, client, camera, tags, loop, files."""

import json
from pathlib import Path

import numpy as np
import pytest

from contactgraph import cli
from contactgraph.data import read_trajectories
from contactgraph.tasks.franka_recording import FrankaRecording, grasps

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


def test_most_runs_grasp_and_the_seed_says_which() -> None:
    seeds = range(300)
    assert 0.6 < np.mean([grasps(seed) for seed in seeds]) < 0.8
    assert grasps(3) == grasps(3)


def passes(policy: FrankaRecording, seed: int) -> tuple[float, float]:
    """How near, m, the hand comes to the block, and its slowest speed, m/s, as it is there."""
    from contactgraph.tasks.franka_pickup import pickup_scene

    goal = np.array([0.6, 0.2, 0.3])
    policy.reset(pickup_scene(0.01, goal), seed)
    hand, velocity, block = np.array([0.4, -0.2, 0.3]), np.zeros(3), np.array([0.5, 0.0, 0.05])
    nearest, slowest = np.inf, np.inf
    for _ in range(1000):
        observation = {
            "position": np.stack([hand, block]),
            "velocity": np.stack([velocity, np.zeros(3)]),
            "goal": goal,
        }
        velocity = velocity + policy(observation) / 4.0 * 0.01
        hand = hand + velocity * 0.01
        distance = float(np.linalg.norm(hand - block))
        nearest = min(nearest, distance)
        if distance < 0.02:
            slowest = min(slowest, float(np.linalg.norm(velocity)))
    return nearest, slowest


@pytest.mark.parametrize("wanted", [True, False])
def test_a_tour_keeps_away_from_the_block_and_a_grasp_goes_to_it(wanted: bool) -> None:
    policy = FrankaRecording()
    for seed in [seed for seed in range(20) if grasps(seed) is wanted]:
        nearest, _ = passes(policy, seed)
        assert (nearest < 0.03) if wanted else (nearest > 0.08)


def test_some_grasps_are_made_at_rest_and_none_where_none_are_wanted() -> None:
    seeds = [seed for seed in range(20) if grasps(seed)]
    assert all(passes(FrankaRecording(0.0), seed)[1] > 0.2 for seed in seeds)
    assert all(passes(FrankaRecording(1.0), seed)[1] < 0.1 for seed in seeds)
    rest = [passes(FrankaRecording(), seed)[1] < 0.1 for seed in seeds]
    assert 0.2 < np.mean(rest) < 0.8
