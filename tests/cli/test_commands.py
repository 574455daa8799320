"""Every command as a user calls it: output, files and exit codes."""

import dataclasses
import json
import shutil
import subprocess
import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import jax
import numpy as np
import pytest
import safetensors

from contactgraph.cli import main as cli
from contactgraph.data import (
    Scene,
    Trajectory,
    read_trajectories,
    write_trajectories,
)
from contactgraph.envs import PickupExpert
from contactgraph.envs.planar.world import ENGINES
from contactgraph.envs.registry import make, task_spec
from contactgraph.model import PRESETS, ModelConfig, shipped_model
from contactgraph.model.io import describe_model, load_model, save_model
from contactgraph.policies import EpisodeRecord
from contactgraph.viz.metric_table import short

OPEN_LOOP = {
    "constant_velocity_rmse_moving_m",
    "standing_still_rmse_moving_m",
    "edge_f1_now",
    "n_step_rmse_m",
    "n_step_rmse_moving_m",
    "n_step_rmse_free_m",
    "n_step_rmse_contact_m",
    "constant_velocity_rmse_m",
    "frozen_contact_rmse_m",
    "n_steps",
    "edge_precision",
    "edge_recall",
    "edge_f1",
    "edge_accuracy",
    "switch_time_error_s",
}
CLOSED_LOOP = {
    "success_rate",
    "success_interval",
    "contact_speed_m_s",
    "plan_ms_p50",
    "plan_ms_p99",
    "episodes",
    "seed",
}
COMMANDS = (
    *("collect", "train", "evaluate", "control"),
    *("learn-cost", "reproduce", "robot", "report", "info"),
)


def done(*arguments: object) -> None:
    assert cli.run([str(each) for each in arguments]) == 0


def test_the_real_entry_point(capsys: pytest.CaptureFixture[str]) -> None:
    done("--version")
    assert capsys.readouterr() == (f"contactgraph {version('contactgraph')}\n", "")
    command = [sys.executable, "-m", "contactgraph", "trian"]
    mistake = subprocess.run(command, capture_output=True, text=True)
    assert (mistake.returncode, mistake.stdout) == (2, "")
    assert mistake.stderr.startswith("contactgraph: no command 'trian'; the commands are collect")


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_help_lists_every_command(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    done(*arguments)
    captured = capsys.readouterr()
    assert captured.err == ""
    assert "Learn which objects touch when" in captured.out
    for command in COMMANDS:
        assert command in captured.out


@pytest.mark.parametrize("command", [each for each in COMMANDS if each != "robot"])
def test_help_of_each(capsys: pytest.CaptureFixture[str], command: str) -> None:
    done(command, "--help")
    captured = capsys.readouterr()
    assert captured.err == ""
    assert captured.out.startswith(f"usage: contactgraph {command} ")


def simulator(task: str = "pickup") -> str:
    """Name and version of what a task is simulated by."""
    made = make(task)
    made.reset(seed=0)
    return str(made.scene.metadata["simulator"])


def test_collect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, again = tmp_path / "data.h5", tmp_path / "again.h5"
    options = ["--episodes", 3, "--seed", 7, "--distractors", 2, "--resting", 0.34]
    done("collect", "pickup", *options, "--out", path)
    captured = capsys.readouterr()
    assert captured.out.splitlines() == [
        f"{path}: 3 episodes of pickup, seed 7, on {simulator()}",
        "the expert succeeded in 2 of 2 episodes",
    ]
    assert captured.err.splitlines()[-1] == "collecting: 3 of 3"
    dataset = read_trajectories(path)
    given = {"distractors": 2, "simulator": simulator()}
    assert dataset.metadata == {"task": "pickup", "seed": 7, **given}
    assert [run.scene.node_count for run in dataset] == [4, 4, 4]
    assert [bool(np.any(run.control)) for run in dataset] == [True, True, False]
    done("collect", "pickup", *options, "--goal", "sampled", "--expert", "train", "--out", again)
    assert again.read_bytes() == path.read_bytes(), "one seed, one file"
    done("collect", "pickup", "--episodes", 1, "--seed", 8, "--out", path)
    assert len(read_trajectories(path)) == 1, "a new file replaces the old one"


def test_collect_mixed_numbers_of_objects_in_one_file(tmp_path: Path) -> None:
    path = tmp_path / "data.h5"
    counts = ["--distractors", 1, "--objects", 2, "--mixed"]
    done("collect", "multi-pickup", *counts, "--episodes", 5, "--out", path)
    dataset = read_trajectories(path)
    assert dataset.metadata == {
        "task": "multi-pickup",
        "seed": 0,
        "distractors": 1,
        "objects": 2,
        "mixed": True,
        "simulator": simulator(),
    }
    counts = [(run.scene.metadata["objects"], run.scene.metadata["distractors"]) for run in dataset]
    assert counts == [(1, 0), (1, 1), (2, 0), (2, 1), (1, 0)]


def test_collect_does_not_wait_for_jax(tmp_path: Path) -> None:
    main = "import sys; from contactgraph.cli.main import run; code = run(sys.argv[1:]); "
    main += "sys.exit('jax' in sys.modules or code)"
    arguments = ["collect", "pickup", "--episodes", "1", "--out", str(tmp_path / "data.h5")]
    assert subprocess.run([sys.executable, "-c", main, *arguments]).returncode == 0


@pytest.mark.parametrize(
    ("task", "options", "nodes"),
    [
        ("multi-pickup", {}, 3),
        ("door", {}, 2),
        ("franka", {"distractors": 1, "grasp": "weld"}, 3),
    ],
)
def test_collect_other_tasks(tmp_path: Path, task: str, options: dict, nodes: int) -> None:
    path = tmp_path / "data.h5"
    flags = [word for pair in options.items() for word in ("--option", "{}={}".format(*pair))]
    done("collect", task, *flags, "--episodes", 2, "--exploration", 0.5, "--out", path)
    dataset = read_trajectories(path)
    given = {"distractors": 0, **options, "simulator": simulator(task)}
    assert dataset.metadata == {"task": task, "seed": 0, **given}
    assert [run.scene.node_count for run in dataset] == [nodes, nodes]
    policies = [run.scene.metadata["policy"] for run in dataset]
    assert policies[0].endswith("Expert") and policies[1] == "ExplorationPolicy"
    assert all(run.scene.hinged.any() == (task == "door") for run in dataset)
    assert all(run.scene.dimension == (3 if task == "franka" else 2) for run in dataset)
    assert all(run.scene.metadata.get("grasp") == options.get("grasp") for run in dataset)


def test_train_leaves_a_run_folder(trained: Path, recorded: Path) -> None:
    assert {path.name for path in trained.iterdir()} == {
        "config.json",
        "metrics.jsonl",
        "model.safetensors",
        "checkpoint-0000000008.safetensors",
        "checkpoint-0000000012.safetensors",
    }
    config = json.loads((trained / "config.json").read_text())
    assert (config["model"], config["seed"], config["steps"]) == ("ours-recurrent", 0, 12)
    rows = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [4, 8, 12]
    names = {"step", "prediction", "squared", "rollout", "prior", "held_out_rmse_m", "seconds"}
    assert all(set(row) == names for row in rows)
    assert [row["rollout"] > 0 for row in rows] == [False, False, True]
    header = describe_model(trained / "model.safetensors").training
    assert header["command"] == "contactgraph train data.h5 --model ours-recurrent --seed 0"
    assert (header["seed"], header["runs"], header["held_out_runs"]) == (0, 17, 3)
    assert header["data_sha256"] == config["data_sha256"]
    assert header["held_out_rmse_m"] == min(row["held_out_rmse_m"] for row in rows)
    assert header["held_out_constant_velocity_rmse_m"] == 0.375
    assert header["held_out_standing_still_rmse_m"] == 0.5
    assert header["held_out_moving"] is True and header["training_s"] == 1.2


def test_evaluate(fresh: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "result.json"
    done("evaluate", "pickup", fresh, "--json", path)
    captured = capsys.readouterr()
    assert captured.err == ""
    values = json.loads(path.read_text())
    assert values.keys() >= OPEN_LOOP | {"run", "data", "episodes", "seed"}
    distance = values["contact_distance_m"]
    assert distance == float(load_model(shipped_model("pickup")).model.features.contact_distance)
    assert f"contact distance: {distance:.4g} m, given" in captured.out
    assert values["training_s"] > 0
    assert (values["run"], values["data"]) == ("pickup", str(fresh))
    assert (values["n_steps"], values["episodes"], values["seed"]) == (10, 2, 1)
    inferred = {"edge_f1_now_inferred", "brier_score_inferred"}
    assert all(isinstance(values[name], int | float) for name in OPEN_LOOP | inferred)
    lines = captured.out.splitlines()
    assert lines[0].startswith("error over 10 steps ")
    for text, name in (("the model", "n_step"), ("constant velocity", "constant_velocity")):
        errors = [100 * values[f"{name}_rmse{chosen}_m"] for chosen in ("_moving", "")]
        (line,) = (each for each in lines if each.startswith(text))
        assert line.split()[-4:] == [f"{errors[0]:.3f}", "cm", f"{errors[1]:.3f}", "cm"]
    assert f"verdict: {values['verdict']}" in lines
    now, coming = values["edge_f1_now"], values["edge_f1"]
    assert f"F1 {now:.4f} (step just made), {coming:.4f} (steps to come)" in captured.out
    (tmp_path / "run").mkdir()
    file = tmp_path / "run" / "model.safetensors"
    shutil.copy(shipped_model("pickup"), file)
    for model in (file, file.parent):
        done("evaluate", model, fresh, "--json", path)
        assert json.loads(path.read_text()) == {**values, "run": str(model)}


def test_evaluate_under_forced_controls(
    fresh: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "result.json"
    done("evaluate", "pickup", fresh, "--forced", "--forced-every", 60, "--json", path)
    title, table, *_ = capsys.readouterr().out.splitlines()
    assert title == ("8 windows under random constant forces, one every 60 states of 2 episodes")
    assert table.startswith("error over 10 steps ")
    values = json.loads(path.read_text())
    assert values.keys() >= OPEN_LOOP | {"n_step_mean_moving_inferred_m"}
    assert (values["windows"], values["runs"], values["forced_every"]) == (8, 2, 60)
    low, high = values["n_step_rmse_interval_moving_m"]
    assert low <= values["n_step_rmse_moving_m"] <= high
    assert high < values["constant_velocity_rmse_interval_moving_m"][0]


def test_data_that_cannot_be_replayed(mistake, fresh: Path, tmp_path: Path) -> None:
    dataset = read_trajectories(fresh)
    first = dataset.trajectories[0]
    strange = {**first.scene.metadata, "simulator": "mujoco 3.6.0", "task": "toss"}
    moved = dataclasses.replace(first, position=first.position + 1.0)
    for name, each, text in (
        (
            "strange.h5",
            dataclasses.replace(first, scene=dataclasses.replace(first.scene, metadata=strange)),
            "forced windows need episodes of planar tasks, recorded by collect, with their seeds; "
            "found task toss, simulator mujoco 3.6.0",
        ),
        (
            "class.h5",
            dataclasses.replace(
                first,
                scene=dataclasses.replace(
                    first.scene, metadata={**first.scene.metadata, "task": "os:system"}
                ),
            ),
            "found task os:system, simulator " + str(first.scene.metadata["simulator"]),
        ),
        ("moved.h5", moved, "differs from the recording: position in state 0 of 200"),
    ):
        path = tmp_path / name
        write_trajectories(path, [each], dataset.metadata)
        assert mistake("evaluate", "pickup", path, "--forced").endswith(text)
    assert "--forced-every must be" in mistake(
        "evaluate", "pickup", fresh, "--forced", "--forced-every", 0
    )


@pytest.mark.parametrize("real", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_control(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    real: bool,
) -> None:
    if not real:
        monkeypatch.setattr("contactgraph.policies.task_policy", ByTheExpert)
        monkeypatch.setattr("contactgraph.viz.animation.frame_states", lambda scene: range(9))
    result, video, episodes = (tmp_path / name for name in ("out.json", "out.gif", "out.h5"))
    options = ["--episodes", 2, "--seed", 5, "--replan-every", 5]
    files = ["--json", result, "--video", video, "--save", episodes]
    done("control", "pickup", "pickup", *options, *files)
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1] == "controlling: 2 of 2"
    values = json.loads(result.read_text())
    assert values.keys() >= OPEN_LOOP | CLOSED_LOOP | {"run", "task", "distractors"}
    assert (values["episodes"], values["seed"], values["distractors"]) == (2, 5, 0)
    assert (values["horizon"], values["replan_every"]) == (20, 5)
    low, high = values["success_interval"]
    assert 0 <= low <= values["success_rate"] <= high <= 1
    assert values["plan_ms_p99"] >= values["plan_ms_p50"] > 0
    assert f"of {values['episodes']} episodes" in captured.out
    saved = read_trajectories(episodes)
    assert [run.scene.node_count for run in saved] == [2, 2]
    assert saved.metadata == {"task": "pickup", "seed": 5, "distractors": 0}
    assert video.read_bytes().startswith(b"GIF8")
    assert {path.name for path in tmp_path.iterdir()} == {"out.json", "out.gif", "out.h5"}
    done("control", "expert", "pickup", "--episodes", 1, "--json", result)
    assert json.loads(result.read_text()).keys() <= values.keys(), "a policy has no more numbers"


class ByTheExpert:
    """In place of a `task_policy`: the expert, with perfect plans."""

    def __init__(self, model, task, plans, **options):
        self.horizon, self.expert = plans.horizon, PickupExpert()

    def reset(self, scene, seed):
        self.path = []
        self.expert.reset(scene, seed)

    def __call__(self, observation):
        self.path.append(observation["position"].copy())
        return self.expert(observation)

    def record(self):
        path = np.array([*self.path, self.path[-1]])
        count, steps = path.shape[1], len(path) - 1
        after = np.minimum(np.arange(steps)[:, None] + np.arange(self.horizon + 1), steps)
        edges = np.zeros((steps, count * (count - 1) // 2))
        return EpisodeRecord(
            plan_ms=np.arange(1.0, steps + 1.0),
            status=np.zeros(steps, int),
            plan=path[after],
            plan_belief=np.zeros((steps, self.horizon, edges.shape[1])),
            estimated=edges,
        )


def test_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One test condition, with episodes of the expert; the numbers are those of the files."""
    task = dataclasses.replace(task_spec("pickup"), conditions=(("as trained", {}),))
    monkeypatch.setattr("contactgraph.envs.registry.task_spec", lambda name: task)
    monkeypatch.setattr("contactgraph.policies.task_policy", ByTheExpert)
    page = tmp_path / "report" / "index.html"
    options = ("--test-runs", 1, "--episodes", 2, "--quick", "--beside", "pickup", "pickup")
    done("report", "pickup", *options, "--out", page)
    said = capsys.readouterr().out
    assert f"the report: {page}" in said
    open_loop, beside = sorted((page.parent / "cells").glob("evaluate-*.json"))
    assert (open_loop.stem, beside.stem) == ("evaluate-as-trained", "evaluate-beside-as-trained")
    measured = json.loads(open_loop.read_text())
    rows = [line.strip("| ").split(" | ") for line in said.splitlines() if line.startswith("|")]
    named = dict(row for row in rows if len(row) == 2)
    error = short(100 * measured["n_step_rmse_moving_m"])
    assert named["N-step error of bodies that move"] == f"{error} cm"
    ahead = f"one step ahead, {task.test_conditions()[0].name}"
    assert named[f"calibration error, {ahead}"] == short(measured["calibration_error"])
    text = page.read_text(encoding="utf-8")
    mine, other = json.loads(text.partition('id="report-data">')[2].partition("<")[0])["beliefs"]
    assert mine == other and mine["title"] == "pickup: gripper and target"
    touch = mine["truth"][1][1]
    assert mine["truth"] == [["free", 0, touch], ["contact", touch, 200]]
    assert mine["lines"][0]["states"] == mine["truth"], "measured without an error"
    for value in (measured["edge_f1_now"], measured["edge_f1_now_unmeasured"]):
        assert text.count(f'"figure">{short(value)}</td>') >= 2


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["box2d", "pymunk"])
def test_control_says_that_the_data_came_from_another_engine(
    engine: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("contactgraph.policies.task_policy", ByTheExpert)
    if find_spec(ENGINES[engine]) is None:
        pytest.skip(f"{engine} is not installed")
    done("control", "pickup", "pickup", "--episodes", 1, "--engine", engine)
    said = f"pickup was trained on box2d 2.3.10; these episodes are on {engine} "
    assert (said in capsys.readouterr().out) == (engine == "pymunk")


def test_control_in_space(tmp_path: Path) -> None:
    """Three degrees of freedom and another time step: the same command, files and numbers."""
    model, result, episodes = (tmp_path / name for name in ("m.safetensors", "out.json", "out.h5"))
    config = ModelConfig(3, 3, 0.01, 0.03)
    save_model(
        model, PRESETS["ours-recurrent"](config, key=jax.random.key(0)), "ours-recurrent", config
    )
    plans = ["--horizon", 20, "--replan-every", 20]
    files = ["--json", result, "--save", episodes]
    done("control", model, "franka", "--episodes", 1, "--option", "grasp=weld", *plans, *files)
    values = json.loads(result.read_text())
    assert values.keys() >= OPEN_LOOP | CLOSED_LOOP
    assert (values["task"], values["grasp"], values["horizon"]) == ("franka", "weld", 20)
    assert values["n_steps"] == 50 and values["frozen_contact_rmse_m"] is not None
    (run,) = read_trajectories(episodes)
    assert run.scene.has_weight and run.control.shape == (400, 3) and run.link_positions is not None


def test_info(trained: Path, recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for what, said in {
        trained: [
            "ours-recurrent, seed 0",
            "12 of 12 steps in 1 s",
            "held-out            12.500 cm, last 12.5",
        ],
        trained / "model.safetensors": [
            *("model, ", "2 a node, control 2", "0.05 s", "data_sha256"),
            "contact distance    0.07983 m, given",
        ],
        recorded: [
            "dataset, 20 trajectories",
            "200 of 0.05 s",
            "2: gripper, target",
            "in 20 of 20",
            "actuation           gripper: force, fits to ",
        ],
        "pickup": ["pickup: model, ", "command", "seed"],
    }.items():
        done("info", what)
        captured = capsys.readouterr()
        assert captured.err == ""
        for words in said:
            assert words in captured.out


def test_info_of_a_dataset_names_what_is_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state, pairs = np.zeros((4, 3, 2)), np.zeros((4, 3, 3), bool)
    names = ("hand", "box", "wall")
    scene = Scene(
        *(names, names, np.array([True, False, False]), 0.05),
        static=np.array([False, False, True]),
        control_kind=("force", "force", "switch"),
    )
    plain = Trajectory(scene, state, state, np.zeros((3, 3)), pairs)
    turning = dataclasses.replace(plain, holding=pairs, orientation=np.zeros((4, 3, 1)))
    write_trajectories(tmp_path / "data.h5", [plain, turning])
    done("info", tmp_path / "data.h5")
    lines = {" ".join(line.split()) for line in capsys.readouterr().out.splitlines()}
    assert lines >= {
        "nodes 3: hand, box, wall",
        "control 3: force, force, switch",
        "contacts in 2 of 2 trajectories",
        "holding in 1 of 2 trajectories",
        "orientation in 1 of 2 trajectories",
        "static 1",
        "actuation hand: force, fits to 0 mm/s",
        "wall: at most 0 m/s and 0 rad/s; largest step 0 cm, to 0.05 s of trajectory 1",
    }


def test_info_of_a_checkpoint_names_the_expected_format(
    trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = trained / "checkpoint-0000000012.safetensors"
    with safetensors.safe_open(path, framework="numpy") as file:
        assert json.loads(file.metadata()["contactgraph"])["format"] == "contactgraph-checkpoint"
    assert cli.run(["info", str(path)]) == 2
    assert "must be 'contactgraph-model'" in capsys.readouterr().err
