"""Minari itself: its collector's files are read, and its loader opens what is exported."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest

from contactgraph.data import Dataset
from contactgraph.interchange import read_map, to_trajectories
from contactgraph.interchange.conversion import state_after
from contactgraph.interchange.export_layout import export_layout
from contactgraph.interchange.minari import read_minari, write_minari

pytestmark = pytest.mark.filterwarnings("ignore")


def test_minari_writes_and_reads_fetch_push(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    import gymnasium_robotics
    import minari

    from contactgraph.envs.fetch import FetchPushTask

    gymnasium.register_envs(gymnasium_robotics)
    environment = minari.DataCollector(gymnasium.make("FetchPush-v4", max_episode_steps=6))
    task, states, rng = FetchPushTask(), [], np.random.default_rng(0)
    for seed in range(2):
        observation, _ = environment.reset(seed=seed)
        states.append([state_after(task.mapped(observation), None)])
        for _ in range(6):
            observation, *_ = environment.step(rng.uniform(-1, 1, 4).astype(np.float32))
            states[-1].append(state_after(task.mapped(observation), states[-1][-1]))
    environment.create_dataset(dataset_id="fetch-push/random-v0")
    folder = tmp_path / "fetch-push" / "random-v0"
    found, _ = to_trajectories(read_minari(folder), read_map("fetch-push"))
    task.reset(seed=0)
    for trajectory, recorded in zip(found, states, strict=True):
        for name in ("position", "velocity", "orientation", "angular_velocity"):
            expected = np.stack([each[name] for each in recorded])
            first = 1 if "velocity" in name else 0  # that of the start is not known when it is read
            read = getattr(trajectory, name)[first:]
            np.testing.assert_allclose(read, expected[first:], atol=1e-9, err_msg=name)
        for name in ("node_name", "node_type", "control_kind", "dt", "dimension"):
            assert getattr(trajectory.scene, name) == getattr(task.scene, name)
        for name in ("planes", "gravity", "size", "control_of", "polygon_of", "goal"):
            ours, theirs = getattr(trajectory.scene, name), getattr(task.scene, name)
            if name != "goal" or trajectory is found[0]:
                np.testing.assert_allclose(ours, theirs, err_msg=name)
        for ours, theirs in zip(trajectory.scene.polygons, task.scene.polygons, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-12)
    write_minari(export_layout(Dataset(found)), tmp_path / "contactgraph-v0")
    dataset = minari.load_dataset("contactgraph-v0")
    for episode, trajectory in zip(dataset.iterate_episodes(), found, strict=True):
        np.testing.assert_array_equal(episode.observations[:, :3], trajectory.position[:, 0])
        np.testing.assert_array_equal(episode.actions, trajectory.control)
        assert episode.truncations.tolist() == [False] * 5 + [True]
