"""Model and training defaults derived from trajectories."""

from dataclasses import replace

import numpy as np
import pytest

from contactgraph.data import Dataset, InvalidInputError, Scene, Trajectory
from contactgraph.train import defaults_from_data


def trajectories(*scenes: Scene) -> Dataset:
    def still(scene: Scene) -> Trajectory:
        shape = 3, scene.node_count, scene.dimension
        return Trajectory(scene, np.zeros(shape), np.zeros(shape), np.zeros((2, scene.dimension)))

    return Dataset(tuple(still(scene) for scene in scenes))


def scene(**metadata: float) -> Scene:
    return Scene(
        ("hand", "block"), ("hand", "block"), np.array([1, 0], bool), 0.1, metadata=metadata
    )


def test_the_contact_distance_is_learned_without_a_given_one() -> None:
    found = defaults_from_data(trajectories(scene()))
    assert (found.contact_distance, found.learned_contact_distance) == (0.085, True)
    assert (found.hinges, found.weight, found.rollout_from) == (False, False, 0.5)


def test_a_given_distance_is_kept() -> None:
    found = defaults_from_data(
        trajectories(scene(contact_distance=0.02), scene(contact_distance=0.02))
    )
    assert (found.contact_distance, found.learned_contact_distance) == (0.02, False)


def test_weight_and_hinges_are_detected_in_any_trajectory() -> None:
    heavy = replace(scene(), gravity=np.array([0.0, -9.81]))
    hinged = replace(scene(), anchor=np.array([[np.nan, np.nan], [0.0, 0.0]]))
    found = defaults_from_data(trajectories(scene(), heavy, hinged))
    assert found.weight and found.hinges and found.rollout_from == 0.0
    assert not defaults_from_data(trajectories(replace(scene(), gravity=np.zeros(2)))).weight


@pytest.mark.parametrize("wrong", [0.0, -1.0, float("inf"), "near"])
def test_a_distance_that_is_none_is_refused(wrong) -> None:
    with pytest.raises(InvalidInputError, match="contact_distance must be positive metres"):
        defaults_from_data(trajectories(scene(contact_distance=wrong)))


def test_trajectories_must_not_contradict_each_other() -> None:
    with pytest.raises(InvalidInputError, match="the same in all trajectories"):
        defaults_from_data(trajectories(scene(contact_distance=0.02), scene(contact_distance=0.03)))
