"""Padding adds nothing; splits are by run; runs of one file agree."""

import dataclasses

import numpy as np
import pytest

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Scene,
    Trajectory,
    pad_trajectories,
    pair_indices,
    split_by_trajectory,
    strip_contacts,
)
from contactgraph.interchange import velocity_mismatch, velocity_warning


def random_run(seed: int, steps: int, nodes: int, **changes: object) -> Trajectory:
    rng = np.random.default_rng(seed)
    settings = {"dt": 0.05, "dimension": 2, "control_size": 2, "edges": None} | changes
    scene = Scene(
        tuple(f"n{i}" for i in range(nodes)),
        ("object",) * nodes,
        rng.random(nodes) < 0.5,
        settings["dt"],
        dimension=settings["dimension"],
        candidate_edges=settings["edges"],
    )
    shape = (steps + 1, nodes, settings["dimension"])
    contact = rng.random((steps + 1, nodes, nodes)) < 0.3
    return Trajectory(
        scene,
        rng.normal(size=shape),
        rng.normal(size=shape),
        rng.normal(size=(steps, settings["control_size"])),
        contact | contact.swapaxes(1, 2),
    )


RAGGED = Dataset((random_run(0, 5, 3), random_run(1, 2, 1), random_run(2, 7, 4)), {"task": "x"})


def test_pairs_of_few_nodes_are_a_prefix_of_those_of_many() -> None:
    assert pair_indices(3).tolist() == [[0, 1], [0, 2], [1, 2]]
    for nodes in range(6):
        pairs = pair_indices(nodes)
        assert pairs.shape == (nodes * (nodes - 1) // 2, 2)
        np.testing.assert_array_equal(pair_indices(9)[: len(pairs)], pairs)


@pytest.mark.parametrize("capacity", [None, 6])
def test_padding_contains_the_trajectories_and_nothing_else(capacity: int | None) -> None:
    padded = pad_trajectories(RAGGED, capacity)
    nodes = capacity or 4
    assert padded.position.shape == (3, 8, nodes, 2)
    assert padded.nodes.candidate.shape == (3, nodes * (nodes - 1) // 2)
    total = {"position": 0.0, "velocity": 0.0, "control": 0.0}
    for index, trajectory in enumerate(RAGGED):
        count, steps = trajectory.scene.node_count, trajectory.steps
        real = padded.position[index, : steps + 1, :count]
        np.testing.assert_array_equal(real, trajectory.position)
        np.testing.assert_array_equal(
            padded.velocity[index, : steps + 1, :count], trajectory.velocity
        )
        np.testing.assert_array_equal(padded.control[index, :steps], trajectory.control)
        np.testing.assert_array_equal(np.flatnonzero(padded.nodes.mask[index]), range(count))
        np.testing.assert_array_equal(np.flatnonzero(padded.step_mask[index]), range(steps))
        np.testing.assert_array_equal(
            padded.nodes.actuated[index, :count], trajectory.scene.actuated
        )
        assert padded.nodes.actuated[index].sum() == trajectory.scene.actuated.sum()
        for edge, (first, second) in enumerate(pair_indices(nodes)):
            exists = first < count and second < count
            assert padded.nodes.candidate[index, edge] == exists
            expected = (
                trajectory.contact[:, first, second] if exists else np.full(steps + 1, np.nan)
            )
            np.testing.assert_array_equal(padded.contact[index, : steps + 1, edge], expected)
            assert np.isnan(padded.contact[index, steps + 1 :, edge]).all()
        for name in total:
            total[name] += np.abs(getattr(trajectory, name)).sum()
    for name, expected in total.items():
        assert np.abs(getattr(padded, name)).sum() == pytest.approx(expected), "padding is zero"


def test_candidate_edges_count_in_either_direction() -> None:
    for edges in ([[2, 0]], [[0, 2]], [[2, 0], [0, 2]]):
        padded = pad_trajectories(Dataset((random_run(0, 2, 3, edges=np.array(edges)),)), 4)
        assert padded.nodes.candidate.tolist() == [[False, True, False, False, False, False]]
    empty = pad_trajectories(Dataset((random_run(0, 2, 3, edges=np.zeros((0, 2), int)),)))
    assert not empty.nodes.candidate.any()


def test_contacts_that_are_not_recorded_are_not_known() -> None:
    unlabelled = strip_contacts(RAGGED)
    assert all(trajectory.contact is None for trajectory in unlabelled)
    assert unlabelled.metadata == RAGGED.metadata
    mixed = Dataset((RAGGED.trajectories[0], unlabelled.trajectories[1]))
    first, second = pad_trajectories(mixed).contact
    assert np.isnan(second).all() and np.isfinite(first[:, :3]).all()
    assert pad_trajectories(mixed, contacts=False).contact is None
    np.testing.assert_array_equal(
        pad_trajectories(unlabelled).position, pad_trajectories(RAGGED).position
    )


def test_properties_are_those_that_any_scene_has() -> None:
    """Where two nodes are actuated, all components act on the nodes of a scene that tells none."""
    first, second = random_run(0, 2, 3), random_run(0, 2, 3)
    assert first.scene.actuated.sum() > 1
    acting = np.array([[True, False], [False, True], [False, False]])
    told = dataclasses.replace(first.scene, control_of=acting, size=np.full((3, 2), np.nan))
    runs = (dataclasses.replace(first, scene=told), second)
    nodes = pad_trajectories(runs, 4).nodes
    np.testing.assert_array_equal(nodes.control_of[0], [*acting, [False, False]])
    np.testing.assert_array_equal(nodes.control_of[1, :3], second.scene.actuated[:, None] & [1, 1])
    assert nodes.half_size is None and nodes.pins is None and nodes.pin_points is None
    none = dataclasses.replace(told, pins=np.zeros((0, 2), int), pin_points=np.zeros((0, 2, 2)))
    assert pad_trajectories((dataclasses.replace(first, scene=none),)).nodes.pin_points is None


def test_a_capacity_that_is_too_small() -> None:
    with pytest.raises(InvalidInputError, match="node_capacity must be at least 4"):
        pad_trajectories(RAGGED, 3)


def test_trajectories_must_agree() -> None:
    message = "trajectory 1: dimension D is 3, but 2 in trajectory 0; all must agree"
    with pytest.raises(InvalidInputError, match=message):
        Dataset((random_run(0, 3, 2), random_run(1, 3, 2, dimension=3)))


def test_split_by_trajectory() -> None:
    dataset = Dataset(tuple(random_run(i, 1, 1) for i in range(10)), {"task": "x"})
    train, held_out = split_by_trajectory(dataset, 0.2, seed=1)
    assert (len(train), len(held_out)) == (8, 2)
    assert train.metadata == held_out.metadata == dataset.metadata
    place = {id(trajectory): i for i, trajectory in enumerate(dataset)}
    parts = [[place[id(trajectory)] for trajectory in part] for part in (train, held_out)]
    assert sorted(parts[0] + parts[1]) == list(range(10))
    assert parts == [sorted(part) for part in parts]
    again = split_by_trajectory(dataset, 0.2, seed=1)[1]
    assert [place[id(trajectory)] for trajectory in again] == parts[1]
    others = {
        tuple(place[id(trajectory)] for trajectory in split_by_trajectory(dataset, 0.2, s)[1])
        for s in range(9)
    }
    assert len(others) > 3, "the seed decides"


@pytest.mark.parametrize(("fraction", "held_out"), [(0.01, 1), (0.99, 2)])
def test_neither_side_of_a_split_is_empty(fraction: float, held_out: int) -> None:
    assert len(split_by_trajectory(RAGGED, fraction, seed=0)[1]) == held_out


def test_splits_that_cannot_be_made() -> None:
    with pytest.raises(InvalidInputError, match="needs at least 2 trajectories, found 1"):
        split_by_trajectory(Dataset(RAGGED.trajectories[:1]), 0.5, seed=0)
    for fraction in (0.0, 1.0, -1.0, float("nan")):
        with pytest.raises(InvalidInputError, match="must lie between 0 and 1"):
            split_by_trajectory(RAGGED, fraction, seed=0)


def moving(factor: float) -> Trajectory:
    """A body on a circle and one at rest; the velocities are ``factor`` times the true ones."""
    angle = np.linspace(0.0, 6.0, 61)[:, None]
    position = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
    velocity = factor * np.concatenate([-np.sin(angle), np.cos(angle)], axis=1)
    scene = Scene(("a", "b"), ("x", "x"), np.array([True, False]), 0.1)
    still = np.zeros_like(position)
    return Trajectory(
        scene,
        np.stack([position, still], axis=1),
        np.stack([velocity, still], axis=1),
        np.zeros((60, 1)),
    )


@pytest.mark.parametrize(
    ("factor", "mismatch"), [(1.0, 0.0), (1.2, 1 / 6), (0.8, 0.2), (1000.0, 0.999), (0.0, 1.0)]
)
def test_velocities_that_contradict_positions_are_measured(factor: float, mismatch: float) -> None:
    assert velocity_mismatch(moving(factor)) == pytest.approx(mismatch, abs=2e-3)


def test_a_contradiction_is_a_warning_in_one_line() -> None:
    assert velocity_warning(Dataset((moving(1.0), moving(1.05)))) is None
    assert velocity_warning(Dataset((random_run(0, 1, 1, dimension=1),))) is not None
    assert velocity_warning(Dataset((moving(1.0), moving(1.2), moving(0.5)))) == (
        "velocities contradict positions in 2 of 3 trajectories, by 50 % of the motion in "
        "trajectory 2; check units and dt"
    )


def test_a_body_at_rest_contradicts_nothing() -> None:
    still = moving(0.0)
    at_rest = dataclasses.replace(still, position=np.zeros_like(still.position))
    assert velocity_mismatch(at_rest) == 0.0
    noise = np.random.default_rng(0).normal(size=(2, *at_rest.position.shape))
    position = at_rest.position + [[0.0, 0.0], [0.1, 0.0]] + 1e-6 * noise[0]
    borne = dataclasses.replace(at_rest, position=position, velocity=1e-6 * noise[1])
    assert velocity_mismatch(borne) == 0.0
    assert velocity_mismatch(dataclasses.replace(borne, velocity=1e-4 * noise[1])) > 0.9


def test_backward_differences_of_rough_motion_do_not_contradict_it() -> None:
    rough = random_run(0, 40, 2)
    position = np.cumsum(rough.velocity, axis=0) * rough.scene.dt
    assert velocity_mismatch(dataclasses.replace(rough, position=position)) < 1e-9
    halved = dataclasses.replace(rough, position=position, velocity=0.5 * rough.velocity)
    assert velocity_mismatch(halved) > 0.3
