"""Bodies whose coordinates are those of a map: errors, trainings and plans are as at the origin."""

from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from evaluation_worlds import by_model

from contactgraph.cli.main import run
from contactgraph.cli.models import stored_model
from contactgraph.data import Dataset, Trajectory, read_trajectories, write_trajectories
from contactgraph.data.dataset import far_origin, near_origin, scene_about
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import collect, evaluate_open_loop
from contactgraph.train import RunFolder

UTM = np.array([5e5, 4.5e6])
AS_TRAINED = (
    *("--model", "ours-recurrent", "--steps", "12", "--batch-size", "4"),
    *("--window-length", "3", "--rollout-from", "0.6"),
)
"""The options of the run `trained`."""


def moved(trajectory: Trajectory, by: np.ndarray) -> Trajectory:
    scene = scene_about(trajectory.scene, -by)
    return replace(trajectory, scene=scene, position=trajectory.position + by)


@pytest.fixture(scope="module")
def near() -> Dataset:
    return Dataset(tuple(collect([PickupTask], [PickupExpert()], 2, 5)))


def test_errors_are_those_at_the_origin(near: Dataset) -> None:
    model = stored_model("pickup")
    far = replace(near, trajectories=tuple(moved(each, UTM) for each in near))
    found, expected = (evaluate_open_loop(model, each).to_json() for each in (far, near))
    for name in ("n_step_rmse_moving_m", "constant_velocity_rmse_moving_m", "edge_f1_now"):
        assert found[name] == pytest.approx(expected[name], rel=0.02, abs=1e-9), name


def test_a_scene_about_another_point_is_the_same_scene(near: Dataset) -> None:
    planes = np.array([[0.6, 0.8, -1.0], [0.0, 1.0, -2.0]])
    first = replace(near.trajectories[0], scene=replace(near.trajectories[0].scene, planes=planes))
    (back,) = near_origin(Dataset((moved(first, UTM),)))
    shift = first.position[0] - back.position[0]
    assert np.ptp(shift, axis=0).max() < 1e-8 and np.abs(back.position).max() < 50.0
    gaps = [e.position[0] @ e.scene.planes[:, :2].T - e.scene.planes[:, 2] for e in (first, back)]
    np.testing.assert_allclose(*gaps, atol=1e-8)
    np.testing.assert_allclose(
        back.scene.goal - back.position[0], first.scene.goal - first.position[0], atol=1e-8
    )
    assert near_origin(near).trajectories[0] is near.trajectories[0], "what is near stays"
    absolute = replace(first.scene, control_kind=("position", "position"))
    assert far_origin(absolute, first.position[0] + UTM) is None


def test_trainings_are_those_at_the_origin(
    recorded: Path, trained: Path, frequent_checks: None, tmp_path: Path
) -> None:
    far = [moved(each, UTM) for each in read_trajectories(recorded)]
    write_trajectories(tmp_path / "far.h5", far)
    assert (
        run(["train", str(tmp_path / "far.h5"), "--out", str(tmp_path / "run"), *AS_TRAINED]) == 0
    )
    found, expected = (
        [row["held_out_rmse_m"] for row in RunFolder(folder).metrics()]
        for folder in (tmp_path / "run", trained)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-3)


class FarPickup(PickupTask):
    """A pickup in the coordinates of a map."""

    def __init__(self) -> None:
        super().__init__()
        spaces = dict(self.observation_space.spaces)
        for name in ("position", "goal"):
            box = spaces[name]
            spaces[name] = gymnasium.spaces.Box(-np.inf, np.inf, box.shape, np.float64)
        self.observation_space = gymnasium.spaces.Dict(spaces)

    @property
    def scene(self):
        return scene_about(super().scene, -UTM)

    def reset(self, **options):
        observation, info = super().reset(**options)
        return self._far(observation), info

    def step(self, action):
        observation, *rest = super().step(action)
        return self._far(observation), *rest

    def _far(self, observation):
        return {**observation, **{n: observation[n] + UTM for n in ("position", "goal")}}


def test_plans_are_those_at_the_origin() -> None:
    model = stored_model("pickup")
    near, _ = by_model(model, PickupTask, 1, 3, replan_every=10)
    far, (trajectory,) = by_model(model, FarPickup, 1, 3, replan_every=10)
    assert near.success_rate == far.success_rate == 1.0
    assert far.goal_distance_m_median == pytest.approx(near.goal_distance_m_median, abs=2e-3)
    assert far.planned.rmse_moving == pytest.approx(near.planned.rmse_moving, rel=0.3)
    assert np.abs(trajectory.position - UTM).max() < 5.0
