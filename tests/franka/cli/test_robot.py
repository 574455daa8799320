"""The commands for arms, on the fake one: texts, files and exit codes."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.data import read_trajectories
from contactgraph_franka.cli.options import ArmOptions, ctrl_c
from contactgraph_franka.envs.pickup import sweep_fits, sweep_start, sweep_yaw
from contactgraph_franka.safety import FakeRobot
from contactgraph_franka.safety.faults import frozen_fault

sys.path.insert(0, str(Path(__file__).parents[1] / "loop"))
from scripted import feedback_planner

GOAL = ["--goal", "0.5", "0.2", "0.3"]
RUN = ["robot", "run", "franka", "fake", *GOAL]


def run(*arguments: object) -> int:
    return cli.run([str(each) for each in arguments])


def repeated(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """Runs a command again where a busy machine missed its deadlines."""
    for _ in range(4):
        code = run(*arguments)
        output = capsys.readouterr()
        if not ("in time" in output.err or "too late" in output.err):
            break
    return code, output.out


@pytest.fixture
def light_planner(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces MPC, whose process compiles for seconds, by a plan that pushes along y."""
    monkeypatch.setattr("contactgraph_franka.cli.control.mpc_planner", feedback_planner)


def test_check_describes_the_arm_and_its_timing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "check.json"
    code = run("robot", "check", "fake", "--seconds", 0.5, "--json", path)
    output = capsys.readouterr()
    numbers = json.loads(path.read_text())
    assert {"rate_hz", "jitter_ms_p99", "states_hz", "stop"} <= set(numbers)
    assert "at most 16 N" in output.out and "Hz held" in output.out
    # On a machine that is too busy, one line says so.
    fit = numbers["rate_hz"] >= 500.0 and numbers["jitter_ms_p99"] <= 3.0
    assert code == (0 if fit and numbers["stop"] == "finished" else 1)
    assert ("fit to be controlled" in output.out) == (code == 0)
    assert output.err.count("\n") == (code != 0)


def test_dry_run_prints_plans_and_sends_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], light_planner: None
) -> None:
    path, save = tmp_path / "dry.json", tmp_path / "dry.h5"
    arguments = ["--seconds", 0.3, "--dry-run", "--json", path, "--save", save]
    code, output = repeated(capsys, *RUN, *arguments)
    assert code == 0
    assert "nothing is sent" in output and "first force (0.0, 3.0, 0.0) N; in 0.4 s" in output
    numbers = json.loads(path.read_text())
    assert numbers["dry_run"] and numbers["plans"] > 0
    (trajectory,) = read_trajectories(save)
    assert not trajectory.control.any()
    assert np.ptp(trajectory.position[:, 0], axis=0).max() < 1e-3


def check_run(tmp_path: Path, capsys: pytest.CaptureFixture[str], seconds: float) -> None:
    path, save = tmp_path / "run.json", tmp_path / "run.h5"
    arguments = ["--seconds", seconds, "--save", save, "--json", path]
    code, output = repeated(capsys, *RUN, *arguments)
    assert code == 0
    assert "the hand first moves slowly" in output and "success    " in output
    numbers = json.loads(path.read_text())
    assert numbers["stop"] == "finished" and numbers["goal"] == [0.5, 0.2, 0.3]
    assert isinstance(numbers["success"], bool) and numbers["plan_ms_p99"] > 0.0
    (trajectory,) = read_trajectories(save)
    assert trajectory.scene.dt == 0.001 and trajectory.steps > 600 * seconds
    assert trajectory.scene.metadata["model"] == "franka"
    # Under at least 1 N, 4 kg move by more than this.
    moved = np.linalg.norm(trajectory.position[-1, 0] - trajectory.position[0, 0])
    assert moved > 0.05 * seconds**2


def test_run_moves_the_hand_and_is_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], light_planner: None
) -> None:
    check_run(tmp_path, capsys, 0.6)


@pytest.mark.slow
def test_run_with_mpc(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check_run(tmp_path, capsys, 1.5)


def test_recording_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("contactgraph_franka.cli.record._SHORTEST_S", 0.2)
    path = tmp_path / "demos.h5"
    record = ["robot", "record", "fake", "--out", path, "--seconds", 0.4, "--seed", 3]
    assert repeated(capsys, *record, "--runs", 1)[0] == 0
    (first,) = read_trajectories(path)
    assert repeated(capsys, *record, "--runs", 2)[0] == 0
    again, second = read_trajectories(path)
    np.testing.assert_array_equal(again.position, first.position)
    assert not np.allclose(first.scene.goal, second.scene.goal)
    assert run(*record, "--runs", 2) == 0
    assert "has its 2 trajectories already" in capsys.readouterr().out
    assert run(*record[:-1], 4, "--runs", 3) == 2
    assert "was recorded with --seed 3 --noise 0.5; use the same" in capsys.readouterr().err
    assert [each.steps for each in read_trajectories(path)] == [first.steps, second.steps]


@pytest.mark.slow
def test_recorded_steps_are_subsampled_for_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "demos.h5"
    arguments = ["--out", path, "--seconds", 1.2, "--runs", 2]
    assert repeated(capsys, "robot", "record", "fake", *arguments)[0] == 0
    # Recorded in steps of 0.001 s, trained in steps of 0.01 s.
    out = ["--out", tmp_path / "run", "--steps", 2, "--rollout-from", 1]
    out += ["--model", "ours-recurrent", "--batch-size", 4, "--window-length", 3]
    assert run("train", path, "--every", 10, *out) == 0
    assert run("evaluate", tmp_path / "run", path) == 0
    assert "every 10th step is taken" in capsys.readouterr().out
    assert run("train", path, "--every", 0, *out) == 2


def test_stop_is_reported_and_the_recording_kept(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    light_planner: None,
) -> None:
    class Freezes(FakeRobot):
        def __init__(self) -> None:
            super().__init__(0, [frozen_fault(300, 10**9)])

    monkeypatch.setattr("contactgraph_franka.cli.arms.FakeRobot", Freezes)
    save = tmp_path / "run.h5"
    assert run(*RUN, "--save", save, "--stay") == 1
    output = capsys.readouterr()
    assert output.err.startswith("contactgraph: the arm stopped: ")
    assert output.err.count("\n") == 1
    assert save.exists() and read_trajectories(save).trajectories[0].steps > 50


def test_second_ctrl_c_interrupts() -> None:
    previous = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), ctrl_c() as pressed:
        assert not pressed()
        signal.raise_signal(signal.SIGINT)
        assert pressed()
        signal.raise_signal(signal.SIGINT)
        pytest.fail("the second Ctrl-C did not interrupt")
    assert signal.getsignal(signal.SIGINT) is previous


@pytest.mark.slow
def test_ctrl_c_ends_an_episode_gently(tmp_path: Path) -> None:
    save = tmp_path / "run.h5"
    arguments = [*RUN, "--seconds", "60", "--save", str(save)]
    command = [sys.executable, "-c", "from contactgraph.cli.main import main; main()", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if "will sweep" in line:
                break
        time.sleep(2.0)
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
    # On a machine that is too busy, it has ended before.
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
        pytest.param(
            ["run", "pickup", "fake", *GOAL],
            "the model is for dimension D 2, but the robot has 3",
            marks=pytest.mark.slow,
        ),
        (["run", "franka", "fake", *GOAL, "--horizon", 0], "--horizon must be 1 to 1000, found 0"),
        (["run", "franka", "fake", *GOAL, "--save", "no/x.h5"], "folder no does not exist"),
        (["run", "franka", "fake"], "robot run: needs --goal"),
        (["run", "franka", "127.0.0.77", *GOAL], "--block X Y Z must say where the block is"),
        (["check", "fake", "--seconds", -1], "--seconds must be above 0"),
        (["record", "fake", "--out", "x.h5", "--runs", 0], "--runs must be 1 to 1000, found 0"),
        (["record", "fake", "--out", "x.h5", "--noise", -1], "--noise must be at least 0"),
        (["calibrate", "fake", "--out", "x.txt"], "--out must name a file that ends in .json"),
        (["calibrate", "fake", "--out", "x.json", "--tag", 3], "--tag 3 is one of the block's"),
        (["calibrate", "fake", "--out", "x.json"], "the fake arm has no camera"),
        (["fly", "fake"], "robot: takes no fly, but check, run, record"),
        (["rehearse-record", "--out", "x.h5", "--runs", 0], "--runs"),
        (["rehearse-record", "--out", "x.h5", "--seconds", 60], "--seconds"),
        (["rehearse-record", "--out", "x.h5", "--pace", 0], "pace must be 0.1 to 100"),
        (["rehearse-record", "--out", "x.h5", "--stopping", 1.5], "--stopping must be 0 to 1"),
        (["rehearse-control", "franka", "--episodes", 0], "--episodes"),
        (["rehearse-control", "nobody"], "nobody"),
    ],
)
def test_mistakes_are_reported_in_one_line(
    arguments: list[object],
    mistake: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if str(arguments[0]).startswith("rehearse"):
        pytest.importorskip("franky_sim", reason="needs pip install 'contactgraph[rehearsal]'")
    monkeypatch.chdir(tmp_path)
    assert run("robot", *arguments) == 2
    output = capsys.readouterr()
    assert mistake in output.err and output.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_sweep_begins_across_a_side_and_stays_inside() -> None:
    limits = ArmOptions().limits("fake")
    low, high = np.array(limits.workspace_low), np.array(limits.workspace_high)
    goal, count = np.array([0.5, 0.2, 0.3]), 0
    for index in range(50):
        block = np.array([*np.random.default_rng(index).uniform((0.35, -0.3), (0.65, 0.3)), 0.05])
        yaw = 0.1 * index
        hand = sweep_start(block, yaw, goal, low, high)
        if hand is None:
            continue
        count += 1
        assert sweep_fits(hand, block, low, high)
        path = block - hand
        turned = (np.arctan2(path[1], path[0]) - yaw) % (np.pi / 2.0)
        assert min(turned, np.pi / 2.0 - turned) < 1e-9
        assert abs(np.sin(sweep_yaw(hand, block) - np.arctan2(path[1], path[0]))) < 1e-9
    assert count > 20
    assert sweep_start(np.array([2.0, 0.0, 0.05]), 0.0, goal, low, high) is None
