"""Demonstrations as a user records them: one goal for all, an expert without noise."""

from pathlib import Path

import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.data import read_trajectories
from contactgraph.data.dataset import Dataset
from contactgraph.envs import (
    DoorExpert,
    DoorTask,
    MultiPickupTask,
    PickupExpert,
    PickupTask,
)
from contactgraph.envs.episodes import run_episode
from contactgraph_franka.envs.expert import FrankaExpert
from contactgraph_franka.envs.franka_task import FrankaTask

PARTS = {
    "pickup": (PickupTask, PickupExpert, 1),
    "multi-pickup": (MultiPickupTask, PickupExpert, 2),
    "door": (DoorTask, DoorExpert, 1),
    "franka": (FrankaTask, FrankaExpert, 1),
}
"""Task, expert, number of targets."""


def demonstrated(path: Path, task: str, *options: object) -> Dataset:
    arguments = ["collect", task, "--goal", "fixed", "--expert", "demo", *options, "--out", path]
    assert cli.run([str(each) for each in arguments]) == 0
    return read_trajectories(path)


@pytest.mark.slow
@pytest.mark.parametrize("task", PARTS)
def test_demonstrations_of_every_task(tmp_path: Path, task: str) -> None:
    task_class, expert_class, targets = PARTS[task]
    episodes = 2 if task == "franka" else 4
    trajectories = demonstrated(tmp_path / "demos.h5", task, "--episodes", episodes, "--seed", 3)
    assert trajectories.metadata == {
        "task": task,
        "seed": 3,
        "distractors": 0,
        "goal": "fixed",
        "expert": "demo",
    }
    assert all(trajectory.scene.metadata["success"] for trajectory in trajectories)
    assert len({trajectory.scene.metadata["fixed_seed"] for trajectory in trajectories}) == 1
    begins = np.stack([trajectory.position[0] for trajectory in trajectories])
    assert np.array_equal(begins[:, 1:], np.broadcast_to(begins[0, 1:], begins[:, 1:].shape))
    assert begins.shape[1] == 1 + targets
    assert len(np.unique(begins[:, 0], axis=0)) == len(trajectories)
    assert len(np.unique([trajectory.scene.goal for trajectory in trajectories], axis=0)) == 1
    *_, last = trajectories
    metadata = last.scene.metadata
    again = run_episode(
        task_class(fixed_seed=metadata["fixed_seed"]), expert_class(noise=0.0), metadata["seed"]
    )
    assert np.array_equal(again.control, last.control), "no noise, and to be had again"
    other = demonstrated(tmp_path / "other.h5", task, "--episodes", 1, "--seed", 4)
    assert not np.array_equal(next(iter(other)).scene.goal, next(iter(trajectories)).scene.goal)


def test_one_goal_for_any_number_of_distractors(tmp_path: Path) -> None:
    options = ["--distractors", 2, "--objects", 1, "--mixed"]
    trajectories = demonstrated(tmp_path / "demos.h5", "multi-pickup", *options, "--episodes", 6)
    fewer = demonstrated(tmp_path / "fewer.h5", "multi-pickup", *options, "--episodes", 2)
    assert [trajectory.scene.node_count for trajectory in trajectories] == [2, 3, 4, 2, 3, 4]
    assert (
        len({(*trajectory.scene.goal, *trajectory.position[0, 1]) for trajectory in trajectories})
        == 1
    )
    assert len({tuple(trajectory.position[0, 0]) for trajectory in trajectories}) == 6
    for one, again in zip(trajectories, fewer, strict=False):
        assert np.array_equal(one.position, again.position), "the same, however many are recorded"


def test_trajectories_of_one_goal_can_be_trained_on(tmp_path: Path) -> None:
    path = tmp_path / "data.h5"
    arguments = ["collect", "pickup", "--goal", "fixed", "--resting", "0.5", "--episodes", "2"]
    assert cli.run([*arguments, "--out", str(path)]) == 0
    trajectories = read_trajectories(path)
    assert "expert" not in trajectories.metadata and trajectories.metadata["goal"] == "fixed"
    assert [bool(np.any(trajectory.control)) for trajectory in trajectories] == [True, False]
