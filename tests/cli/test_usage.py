"""User errors: exit code 2, one helpful line, and no file left."""

import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.data import Scene, Trajectory, read_trajectories, write_trajectories
from contactgraph.envs.registry import task_names
from contactgraph.model import PRESETS, ModelConfig, shipped_models
from contactgraph.model.io import save_model

NO_TASK = f"task must be one of {', '.join(task_names())}, module:Class; found 'juggling'"
NO_MODEL = "nobody: no such run folder or model file; models that ship are"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            "trian",
            "no command 'trian'; the commands are collect, import, export, train, evaluate, "
            "control, play, learn-cost, report, info, reproduce, robot; did you mean train?",
        ),
        (
            "robot chekc fake",
            "robot: takes no chekc, but check, run, record, calibrate, rehearse, "
            "rehearse-record, rehearse-control (see contactgraph robot --help)",
        ),
        ("robot", "robot: Expected one of {check, run, record, calibrate, rehearse, rehearse-reco"),
        ("--out x", "no command '--out'; the commands are collect"),
        ("train", "train: needs DATA and --out (see contactgraph train --help)"),
        ("control x", "control: needs TASK (see"),
        ("info a b", "info: takes no b (see"),
        ("train a --out b --stps 3", "train: takes no --stps, 3; did you mean --steps? (see"),
        ("train a --stps 3", "train: takes no --stps 3 (see"),
        ("train a --out b --resume yes", "train: takes no yes (see"),
        ("collect pickup --out", "collect: Missing value for argument '--out'. Expected 1 values."),
        ("train a --out b --steps x", "train: --steps must be an integer, found 'x' (see"),
        (
            "collect pickup --out b --episodes 1.5",
            "collect: --episodes must be an integer, found '1.5'",
        ),
        ("train a --out b --learning-rate x", "train: --learning-rate must be a number, found 'x'"),
        ("control a b --deadline-ms x", "control: --deadline-ms must be a number, found 'x'"),
        ("control a b --objects x", "control: --objects must be an integer, found 'x'"),
        ("collect nothing:Task --out a.h5", "task nothing:Task: No module named 'nothing'"),
        ("collect json:Task --out a.h5", "task json:Task: module 'json' has no attribute 'Task'"),
        ("collect json:dumps --out a.h5", "task json:dumps: must be a class, found <function d"),
        ("collect juggling --out a.h5", NO_TASK),
        ("control nobody juggling", NO_TASK),
        ("report pickup --beside pickup juggling", NO_TASK),
        ("report pickup --beside nobody pickup", NO_MODEL),
        ("control nobody pickup", NO_MODEL),
        ("evaluate nobody a.h5", NO_MODEL),
        ("evaluate . a.h5", ".: has no model.safetensors; it must be a folder that train has made"),
        ("evaluate pickup a.h5", "a.h5: does not exist"),
        ("learn-cost pickup a.h5 --out a.json", "a.h5: does not exist"),
        ("collect pickup --out a.h5 --engine bullet", "engine must be one of box2d, pymunk, found"),
        ("collect pickup --out a.h5 --episodes 0", "--episodes must be 1 to 100000, found 0"),
        ("collect pickup --out a.h5 --episodes 99999999999", "--episodes must be 1 to 100000"),
        ("collect pickup --out a.h5 --seed -1", "--seed must be 0 to 4294967295, found -1"),
        ("collect pickup --out a.h5 --seed 4294967296", "--seed must be 0 to 4294967295"),
        ("collect pickup --out a.h5 --goal fixed --seed -1", "--seed must be 0 to 4294967295, fou"),
        ("collect pickup --out a.h5 --distractors -1", "distractors must be 0 to 20, found -1"),
        ("collect door --out a.h5 --mixed --distractors -1", "distractors must be 0 to 10, found"),
        ("collect multi-pickup --out a.h5 --mixed --objects 0", "objects must be 1 to 5, found 0"),
        (
            "collect franka --out a.h5 --option grasp=glue",
            "grasp must be one of friction, weld; found",
        ),
        ("collect pickup --out a.h5 --resting 2", "--resting must be 0 to 1, found 2.0"),
        ("collect pickup --out a.h5 --resting nan", "--resting must be 0 to 1, found nan"),
        (
            "collect pickup --out a.h5 --resting 0.6 --exploration 0.6",
            "--exploration and --resting together must not exceed 1",
        ),
        ("collect pickup --out a.h5 --goal moving", "--goal must be one of sampled, fixed; found"),
        ("collect pickup --out a.h5 --expert best", "--expert must be one of train, demo; found"),
        (
            "collect pickup --out a.h5 --expert demo --resting 0.1",
            "--expert demo: every episode is a demonstration, so --exploration and --resting must",
        ),
        (
            "collect multi-pickup --out a.h5 --goal fixed --mixed --objects 2",
            "--goal fixed: all episodes have the same objects, so --mixed takes --objects 1 or",
        ),
        ("collect billiards --out a.h5 --passive --expert demo", "--passive: nothing is driven"),
        ("collect billiards --out a.h5 --passive --exploration 1", "--passive: nothing is driven"),
        ("collect pickup --out no/a.h5", "no/a.h5: folder no does not exist"),
        ("collect pickup --out .", ".: must be a file, found a folder"),
        ("train a.h5 --out run", "a.h5: does not exist"),
        ("train a.h5 --out run --resume", "run: not a run folder (it has no config.json)"),
        ("train a.h5 --out run --model best", "--model must be one of ours, ours-recurrent, ours"),
        ("train a.h5 --out run --steps 0", "steps must be 1 to 1000000000, found 0"),
        ("train a.h5 --out run --batch-size 999999999", "batch_size must be 1 to 65536"),
        (
            "train a.h5 --out run --model ours-recurrent --bystanders -1",
            "bystanders must be 0 to 100, found -1",
        ),
        (
            "train a.h5 --out run --bystanders 2",
            "--bystanders 2: only for ablations and the paper's forms, not for ours",
        ),
        (
            "train a.h5 --out run --prior-weight 0",
            "--prior-weight 0.0: only for ablations and the paper's forms, not for",
        ),
        ("train a.h5 --out run --seed -1", "--seed must be 0 to 4294967295, found -1"),
        (
            "train a.h5 --out run --model ours-recurrent --edge-types 4",
            "--edge-types 4: only for ours and relations, not for ours-recurrent",
        ),
        (
            "train a.h5 --out run --graph star --temperature 1",
            "--graph star and --temperature 1.0: only for the paper's forms, not for ours",
        ),
        ("train a.h5 --out run --graph ring", "--graph must be one of full, star; found 'ring'"),
        ("train a.h5 --out run --temperature 0", "--temperature must be positive, found 0.0"),
        ("train a.h5 --out run --contact-distance -1", "--contact-distance must be positive metr"),
        ("train a.h5 --out run --contact-distance inf", "--contact-distance must be positive met"),
        ("control nobody pickup --episodes 0", "--episodes must be 1 to 100000, found 0"),
        ("control nobody pickup --horizon 0", "--horizon must be 1 to 1000, found 0"),
        ("control nobody pickup --clearance -1", "--clearance must be 0 to 10, found -1"),
        ("control nobody pickup --routes 1001", "--routes must be 0 to 1000, found 1001"),
        ("control pickup pickup --segment 21", "--segment must be 0 to 20, found 21"),
        (
            "control franka franka --clearance 0.1 --routes 0",
            "a clearance from bodies needs their radius, which the scene has not; with a ",
        ),
        ("control nobody pickup --seed -1", "--seed must be 0 to 4294967295, found -1"),
        ("control nobody pickup --video a.png", "video: a.png must end in .gif or .mp4"),
        ("control nobody pickup --video no/a.gif", "no/a.gif: folder no does not exist"),
        ("control nobody pickup --json no/a.json", "no/a.json: folder no does not exist"),
        ("control nobody pickup --save no/a.h5", "no/a.h5: folder no does not exist"),
        ("info nothing", "nothing: does not exist; models that ship are"),
        ("info nothing.safetensors", "nothing.safetensors: no such run folder or model file"),
        ("info .", ".: not a run folder (it has no config.json)"),
    ],
)
def test_mistakes_in_the_arguments(mistake: Callable, arguments: str, said: str) -> None:
    assert mistake(*arguments.split()).startswith(said)


@pytest.mark.parametrize(
    "command", ["train {} --out run", "evaluate pickup {} --json out.json", "info {}"]
)
def test_files_that_are_no_good(
    mistake: Callable, recorded: Path, tmp_path: Path, command: str
) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    for name, content in {
        "foreign.h5": b"once upon a time",
        "empty.h5": b"",
        "truncated.h5": recorded.read_bytes()[:5000],
        "other.h5": (tmp_path / "other.h5").read_bytes(),
    }.items():
        (tmp_path / name).write_bytes(content)
        assert mistake(*command.format(name).split()).startswith(f"{name}: ")
    if not command.startswith("info"):  # which looks at no numbers
        (tmp_path / "nan.h5").write_bytes(recorded.read_bytes())
        with h5py.File(tmp_path / "nan.h5", "r+") as file:
            file["trajectories/000003/velocity"][7, 1, 0] = np.nan
        said = mistake(*command.format("nan.h5").split())
        assert re.match(r"nan\.h5: trajectories/000003.*velocity.*finite.*nan", said), said


def run_of(dimension: int, control_size: int, dt: float, steps: int = 40) -> Trajectory:
    state = np.zeros((steps + 1, 2, dimension))
    scene = Scene(("a", "b"), ("x", "x"), np.array([True, False]), dt, dimension)
    return Trajectory(scene, state, state, np.zeros((steps, control_size)))


def test_a_model_and_data_that_do_not_fit(mistake: Callable, trained: Path, tmp_path: Path) -> None:
    write_trajectories(tmp_path / "other.h5", [run_of(3, 2, 0.05)] * 2)
    said = mistake("evaluate", trained, "other.h5", "--json", "out.json")
    assert said == "the model is for dimension D 2, but the data has 3; they must agree"


def test_a_model_and_a_task_that_do_not_fit(mistake: Callable, tmp_path: Path) -> None:
    config = ModelConfig(3, 2, 0.05)
    model = PRESETS["ours-recurrent"](config, key=jax.random.key(0))
    save_model(tmp_path / "m.safetensors", model, "ours-recurrent", config)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("contactgraph.cli.output.Progress.advance", lambda *arguments: None)
        said = mistake("control", "m.safetensors", "pickup", "--episodes", 1, "--save", "a.h5")
    assert said == "the model is for dimension D 3, but the task has 2; they must agree"


def test_a_control_that_does_not_reach_an_actuated_body(mistake: Callable, tmp_path: Path) -> None:
    write_trajectories(tmp_path / "axis.h5", [run_of(2, 1, 0.05)] * 2)
    said = mistake("train", "axis.h5", "--out", "run", "--window-length", 5)
    assert said.startswith("axis.h5 has actuated nodes, but control size U 1; it must be at least")


def test_trajectories_too_few_or_too_short(
    mistake: Callable, recorded: Path, tmp_path: Path
) -> None:
    write_trajectories(tmp_path / "one.h5", [run_of(2, 2, 0.05)])
    assert "needs at least 2 trajectories, found 1" in mistake("train", "one.h5", "--out", "run")
    said = mistake("train", recorded, "--out", "run", "--window-length", 500)
    assert said.startswith("window_length must be 1 to 200")
    said = mistake("train", recorded, "--out", "run", "--held-out", 2)
    assert said.startswith("held_out_fraction must lie between 0 and 1")


def test_an_existing_run_folder_is_not_changed(
    mistake: Callable, trained: Path, recorded: Path
) -> None:
    before = {path.name: path.read_bytes() for path in trained.iterdir()}
    said = mistake("train", recorded, "--out", trained)
    assert said == f"{trained}: holds a run already; use --resume, or another folder"
    assert {path.name: path.read_bytes() for path in trained.iterdir()} == before


def test_resuming_with_other_data(mistake: Callable, trained: Path, fresh: Path) -> None:
    said = mistake("train", fresh, "--out", trained, "--resume")
    assert said == f"{fresh}: not the data that {trained} was begun with"


def test_resuming_without_a_checkpoint(
    mistake: Callable, trained: Path, recorded: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_bytes((trained / "config.json").read_bytes())
    said = mistake("train", recorded, "--out", run, "--resume")
    assert said == f"{run}: has no checkpoint to resume from"
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**config, "steps": "many"}))
    said = mistake("train", recorded, "--out", run, "--resume")
    assert said == f"{run}/config.json: steps must be a number, found 'many'"


def test_mujoco_missing(tmp_path: Path) -> None:
    main = """
import sys
from contactgraph.cli.main import run
sys.modules["mujoco"] = None
sys.exit(sum(run(["collect", task, "--out", "a.h5"]) for task in ("franka", "toss")))
"""
    finished = subprocess.run(
        [sys.executable, "-c", main], cwd=tmp_path, capture_output=True, text=True
    )
    said = "contactgraph: MuJoCo is not installed: pip install 'contactgraph[mujoco]'\n"
    assert (finished.returncode, finished.stdout, finished.stderr) == (2 + 2, "", 2 * said)
    assert not any(tmp_path.iterdir())


def test_info_names_the_missing_library_beside_the_task() -> None:
    """Also where a package is there, but a library that it needs is not."""
    hidden = "import sys; sys.modules['mujoco'] = sys.modules['pymunk'] = None; "
    main = "from contactgraph.cli.main import main; main(['info'])"
    finished = subprocess.run(
        [sys.executable, "-c", hidden + main], capture_output=True, text=True, check=True
    )
    rows = [re.split(r" {2,}", line.strip()) for line in finished.stdout.splitlines()]
    told = {row[0]: row[1] for row in rows if len(row) == 2}
    names = task_names()
    assert set(told) == {*shipped_models(), *names, "module:Class"}
    for package, library, extra, tasks in (
        ("gymnasium_robotics", "mujoco", "fetch", [each for each in names if "fetch" in each]),
        ("gym_pusht", "pymunk", "pusht", ["pusht", "pusht-pose"]),
    ):
        missing = library if importlib.util.find_spec(package) else package
        for task in tasks:
            assert re.fullmatch(
                rf"not available: \S+ cannot start \(.*\b{missing}\b.*\): "
                rf"pip install 'contactgraph\[{extra}\]'",
                told[task],
            )


def test_a_closed_pipe_is_no_mistake() -> None:
    main = "import sys; from contactgraph.cli.main import main; main(sys.argv[1:])"
    done = subprocess.run(
        f"{sys.executable} -c '{main}' train --help | true; exit ${{PIPESTATUS[0]}}",
        shell=True,
        executable="/bin/bash",
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_training_warns_of_pulls_that_tell_the_hold(
    tmp_path: Path, interrupted: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    interrupted("contactgraph.train.fit")
    command = ["collect", "suction", "--hidden-switch", "--episodes", "8", "--out"]
    for data, options, warns in (("told", ["--exploration", "0"], True), ("half", [], False)):
        path = str(tmp_path / f"{data}.h5")
        assert cli.run([*command, path, *options]) == 0
        assert cli.run(["train", path, "--out", str(tmp_path / data)]) == 130
        said = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
        assert [" pulls at a body in contact it is held" in line for line in said] == [True] * warns


def test_training_warns_of_velocities_that_contradict_positions(
    recorded: Path, tmp_path: Path, interrupted: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    slow = [replace(each, velocity=each.velocity / 1000.0) for each in read_trajectories(recorded)]
    write_trajectories(tmp_path / "slow.h5", slow)
    interrupted("contactgraph.train.fit")
    for data, contradict in ((tmp_path / "slow.h5", True), (recorded, False)):
        out = str(tmp_path / data.stem)
        assert cli.run(["train", str(data), "--out", out, "--model", "ours-recurrent"]) == 130
        said = capsys.readouterr().err
        assert ("warning" in said) == contradict
        assert ("velocities contradict positions in 20 of 20 trajectories" in said) == contradict
