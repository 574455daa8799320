"""The commands for arms, on the fake one: what they say, what they write, how they exit."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.data import describe_file, read_trajectories
from contactgraph_franka.cli.options import ArmOptions
from contactgraph_franka.envs.pickup import sweep_fits, sweep_start, sweep_yaw
from contactgraph_franka.safety import FakeRobot
from contactgraph_franka.safety.faults import frozen_fault

GOAL = ["--goal", "0.5", "0.2", "0.3"]


def told(*arguments: object) -> int:
    return cli.run([str(each) for each in arguments])


def patiently(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """Again, where this machine was too busy for what has nothing to do with the test."""
    for _ in range(4):
        code = told(*arguments)
        said = capsys.readouterr()
        if not ("in time" in said.err or "too late" in said.err):
            break
    return code, said.out


def test_check_says_what_it_is_and_how_well_it_keeps_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "check.json"
    code = told("robot", "check", "fake", "--seconds", 0.5, "--json", path)
    said = capsys.readouterr()
    numbers = json.loads(path.read_text())
    assert {"rate_hz", "jitter_ms_p99", "states_hz", "stop"} <= set(numbers)
    assert "at most 16 N" in said.out and "Hz held" in said.out
    # A machine that is too busy is told so, in one line.
    fit = numbers["rate_hz"] >= 500.0 and numbers["jitter_ms_p99"] <= 3.0
    assert code == (0 if fit and numbers["stop"] == "finished" else 1)
    assert ("fit to be controlled" in said.out) == (code == 0)
    assert said.err.count("\n") == (code != 0)


def test_a_dry_run_says_plans_and_sends_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, save = tmp_path / "dry.json", tmp_path / "dry.h5"
    arguments = ["--seconds", 0.6, "--dry-run", "--json", path, "--save", save]
    code, said = patiently(capsys, "robot", "run", "franka", "fake", *GOAL, *arguments)
    assert code == 0
    assert "nothing is sent" in said and "first force" in said
    numbers = json.loads(path.read_text())
    assert numbers["dry_run"] and numbers["plans"] > 0
    (run,) = read_trajectories(save)
    assert not run.control.any()
    assert np.ptp(run.position[:, 0], axis=0).max() < 1e-3


def test_a_run_moves_the_hand_and_is_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, save = tmp_path / "run.json", tmp_path / "run.h5"
    arguments = ["--seconds", 1.5, "--save", save, "--json", path]
    code, _ = patiently(capsys, "robot", "run", "franka", "fake", *GOAL, *arguments)
    assert code == 0
    numbers = json.loads(path.read_text())
    assert numbers["stop"] == "finished" and numbers["goal"] == [0.5, 0.2, 0.3]
    assert isinstance(numbers["success"], bool) and numbers["plan_ms_p99"] > 0.0
    (run,) = read_trajectories(save)
    assert run.scene.dt == 0.001 and run.steps > 1000
    assert run.scene.metadata["model"] == "franka"
    assert np.linalg.norm(run.position[-1, 0] - run.position[0, 0]) > 0.05


def test_records_go_on_where_they_were_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "demos.h5"
    record = ["robot", "record", "fake", "--out", path, "--seconds", 1.2, "--seed", 3]
    assert patiently(capsys, *record, "--runs", 1)[0] == 0
    (first,) = read_trajectories(path)
    assert patiently(capsys, *record, "--runs", 2)[0] == 0
    again, second = read_trajectories(path)
    np.testing.assert_array_equal(again.position, first.position)
    assert not np.allclose(first.scene.goal, second.scene.goal)
    assert told(*record, "--runs", 2) == 0
    assert "has its 2 trajectories already" in capsys.readouterr().out
    assert told(*record[:-1], 4, "--runs", 3) == 2
    assert "was recorded with --seed 3" in capsys.readouterr().err
    assert describe_file(path).steps == (first.steps, second.steps)
    # Recorded in steps of 0.001 s, trained in steps of 0.01 s.
    out = ["--out", tmp_path / "run", "--steps", 2]
    assert told("train", path, "--every", 10, *out) == 0
    assert told("evaluate", tmp_path / "run", path) == 0
    assert "every 10th step is taken" in capsys.readouterr().out
    assert told("train", path, "--every", 0, *out) == 2


def test_a_stop_is_told_and_what_came_before_it_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Freezes(FakeRobot):
        def __init__(self) -> None:
            super().__init__(0, [frozen_fault(300, 10**9)])

    monkeypatch.setattr("contactgraph_franka.cli.arms.FakeRobot", Freezes)
    save = tmp_path / "run.h5"
    assert told("robot", "run", "franka", "fake", *GOAL, "--save", save, "--stay") == 1
    said = capsys.readouterr()
    assert said.err.startswith("contactgraph: the arm stopped: ") and said.err.count("\n") == 1
    assert save.exists() and describe_file(save).steps[0] > 50


def test_ctrl_c_ends_a_run_gently(tmp_path: Path) -> None:
    save = tmp_path / "run.h5"
    arguments = ["robot", "run", "franka", "fake", *GOAL, "--seconds", "60", "--save", str(save)]
    command = [sys.executable, "-c", "from contactgraph.cli.main import main; main()", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        for line in run.stdout:
            if "will sweep" in line:
                break
        time.sleep(2.0)
        run.send_signal(signal.SIGINT)
        rest = run.stdout.read()
    # On a machine that is too busy it has ended before.
    assert "a stop was requested" in rest or "in time" in rest or "too late" in rest


@pytest.mark.parametrize(
    ("arguments", "mistake"),
    [
        (["run", "franka", "fake", "--goal", 1, 2, 3], "--goal must be a position in the arm's w"),
        (["run", "franka", "fake", "--goal", 1, 2], "found 1 2"),
        (["run", "franka", "fake", *GOAL, "--seconds", 0], "--seconds must be above 0"),
        (["run", "franka", "fake", *GOAL, "--max-force", 30], "at most 16.8 N, found 30"),
        (["run", "franka", "fake", *GOAL, "--camera", "rendered"], "the fake arm sees for itself"),
        (["run", "frankenstein", "fake", *GOAL], "frankenstein: no such run folder or model file"),
        (["run", "pickup", "fake", *GOAL], "the model is for dimension D 2, but the robot has 3"),
        (["run", "franka", "fake", *GOAL, "--horizon", 0], "--horizon must be 1 to 1000, found 0"),
        (["run", "franka", "fake", *GOAL, "--save", "no/x.h5"], "folder no does not exist"),
        (["run", "franka", "fake"], "robot run needs --goal"),
        (["run", "franka", "127.0.0.77", *GOAL], "--block X Y Z must say where the block is"),
        (["check", "fake", "--seconds", -1], "--seconds must be above 0"),
        (["record", "fake", "--out", "x.h5", "--runs", 0], "--runs must be 1 to 1000, found 0"),
        (["record", "fake", "--out", "x.h5", "--noise", -1], "--noise must be at least 0"),
        (["calibrate", "fake", "--out", "x.txt"], "--out must name a file that ends in .json"),
        (["calibrate", "fake", "--out", "x.json", "--tag", 3], "--tag 3 is one of the block's"),
        (["calibrate", "fake", "--out", "x.json"], "the fake arm has no camera"),
        (["fly", "fake"], "no command 'robot fly'; the commands are"),
    ],
)
def test_mistakes_are_told_in_one_line(
    arguments: list[object],
    mistake: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert told("robot", *arguments) == 2
    said = capsys.readouterr()
    assert mistake in said.err and said.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_sweep_begins_across_a_side_and_stays_inside() -> None:
    limits = ArmOptions().limits("fake")
    low, high = np.array(limits.workspace_low), np.array(limits.workspace_high)
    goal, found = np.array([0.5, 0.2, 0.3]), 0
    for index in range(50):
        block = np.array([*np.random.default_rng(index).uniform((0.35, -0.3), (0.65, 0.3)), 0.05])
        yaw = 0.1 * index
        hand = sweep_start(block, yaw, goal, low, high)
        if hand is None:
            continue
        found += 1
        assert sweep_fits(hand, block, low, high)
        way = block - hand
        turned = (np.arctan2(way[1], way[0]) - yaw) % (np.pi / 2.0)
        assert min(turned, np.pi / 2.0 - turned) < 1e-9
        assert abs(np.sin(sweep_yaw(hand, block) - np.arctan2(way[1], way[0]))) < 1e-9
    assert found > 20
    assert sweep_start(np.array([2.0, 0.0, 0.05]), 0.0, goal, low, high) is None
