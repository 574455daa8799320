"""Scripted policies in place of a model: the same scenes, numbers and files."""

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from test_commands import CLOSED_LOOP, OPEN_LOOP, ByTheExpert

from contactgraph.cli import main as cli
from contactgraph.data import read_trajectories
from contactgraph.envs import PickupExpert, PickupTask, RestPolicy
from contactgraph.envs.registry import task_spec
from contactgraph.evaluate import collect, episode_seeds
from contactgraph.model import ContactDynamics, shipped_model

SCENES = ["pickup", "--distractors", "1", "--episodes", "2", "--seed", "5"]


def control(name: str, *options: object) -> int:
    return cli.run(["control", name, *SCENES, *(str(each) for each in options)])


def test_the_expert_controls_the_scenes_of_a_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []
    monkeypatch.setattr("contactgraph.viz.write_animation", lambda *drawing: drawn.append(drawing))
    result, video, episodes = (tmp_path / name for name in ("out.json", "out.gif", "out.h5"))
    assert control("expert", "--json", result, "--video", video, "--save", episodes) == 0
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1] == "controlling: 2 of 2"
    values = json.loads(result.read_text())
    assert values.keys() >= OPEN_LOOP | CLOSED_LOOP | {"run", "task", "distractors", "horizon"}
    assert (values["run"], values["task"], values["distractors"]) == ("expert", "pickup", 1)
    assert (values["success_rate"], values["episodes"], values["seed"]) == (1.0, 2, 5)
    assert values["touched_bystanders"] == 0 and values["contact_speed_m_s"] > 0.3
    unknown = {name for name, value in values.items() if value is None}
    assert unknown >= OPEN_LOOP | {"plan_ms_p50", "n_step_rmse_planned_m", "edge_f1_found"}
    assert unknown >= {"horizon", "replan_every", "unmeasured", "infer_contacts", "onsets"}
    saved = read_trajectories(episodes)
    assert saved.metadata == {"task": "pickup", "seed": 5, "distractors": 1}
    assert [each.scene.metadata["seed"] for each in saved] == episode_seeds(2, 5)
    task = partial(PickupTask, 1)
    for one, other in zip(saved, collect([task], [PickupExpert(0.0)], 2, 5), strict=True):
        assert np.array_equal(one.control, other.control), "the demonstrator, without noise"
    ends = [np.linalg.norm(each.position[-1, 1] - each.scene.goal) for each in saved]
    assert values["goal_distance_m_mean"] == pytest.approx(np.mean(ends))
    assert f"end to goal, median        {100 * np.median(ends):.2f} cm" in captured.out
    ((path, scene),) = drawn
    first = saved.trajectories[0]
    assert path == video and scene.name == "pickup, 1 distractors" and scene.plan is None
    # Recorded contacts stand for beliefs: that of step t is the contact in state t + 1.
    assert scene.edges.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert np.array_equal(scene.belief[:, 0], first.contact[1:, 0, 1]) and scene.belief[-1, 0] == 1
    assert not scene.belief[:, 1:].any() and np.array_equal(
        scene.trajectory.position, first.position
    )


def test_the_fixed_start_is_the_tasks_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Here it does nothing."""
    monkeypatch.setattr(PickupTask, "fixed_start", RestPolicy, raising=False)
    result = tmp_path / "out.json"
    assert control("fixed-start", "--json", result) == 0
    values = json.loads(result.read_text())
    assert (values["run"], values["success_rate"], values["contact_speed_m_s"]) == (
        *("fixed-start", 0.0),
        None,
    )
    assert "speed at contact, median   no contact" in capsys.readouterr().out
    assert control("expert", "--json", result) == 0
    assert json.loads(result.read_text())["success_rate"] == 1.0


def test_without_a_fixed_start_the_demonstrator_takes_its_place(tmp_path: Path) -> None:
    assert task_spec("door").fixed_start is None
    paths = [tmp_path / "expert.json", tmp_path / "fixed.json"]
    for name, path in zip(("expert", "fixed-start"), paths, strict=True):
        assert cli.run(["control", name, "door", "--episodes", "1", "--json", str(path)]) == 0
    one, other = (json.loads(path.read_text()) for path in paths)
    assert {**one, "run": ""} == {**other, "run": ""}


@pytest.mark.parametrize(
    ("options", "flags"),
    [
        ("--horizon 9", "--horizon"),
        ("--ignore-motion", "--ignore-motion"),
        ("--deadline-ms 5", "--deadline-ms"),
        ("--misses 0.1 --unmeasured", "--misses, --unmeasured"),
        ("--cost cost.json --position-noise 1", "--cost, --position-noise"),
    ],
)
def test_options_of_a_model_are_refused(mistake: Callable, options: str, flags: str) -> None:
    assert mistake("control", "expert", *SCENES, *options.split()) == (
        f"{flags}: for a model only; expert is a scripted policy, which neither plans nor estimates"
    )


def test_a_model_of_that_name_is_given_as_a_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interrupted: Callable
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(shipped_model("pickup"), tmp_path / "expert")
    calls = interrupted("contactgraph.policies.task_policy")
    assert control("./expert") == 130 and control("expert") == 0
    (call,) = calls
    assert isinstance(call.arguments[0], ContactDynamics)


def test_episodes_too_short_to_predict_are_measured_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def short(model, task, plans, **options):
        task.max_steps = 9
        return ByTheExpert(model, task, plans)

    monkeypatch.setattr("contactgraph.policies.task_policy", short)
    result = tmp_path / "out.json"
    assert control("pickup", "--json", result) == 0
    values = json.loads(result.read_text())
    assert values["n_step_rmse_m"] is values["n_steps"] is None
    assert values["success_rate"] == 0.0
    assert "predicted" not in capsys.readouterr().out
