"""Resting bodies put into windows keep their distance and change nothing recorded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.data import Dataset, Scene, Trajectory, TrajectoryBatch, pad_trajectories
from contactgraph.model import Nodes
from contactgraph.train.batch import add_distractor as eager
from contactgraph.train.batch import has_resting_bodies

NEAREST, FARTHEST = 0.1, 0.3
add_distractor = jax.jit(eager)


def windows(position: np.ndarray, mask: list[bool]) -> TrajectoryBatch:
    batch, states, count, _ = position.shape
    pairs = count * (count - 1) // 2
    return TrajectoryBatch(
        position=jnp.asarray(position, jnp.float32),
        velocity=jnp.ones(position.shape),
        control=jnp.zeros((batch, states - 1, 2)),
        contact=None,
        nodes=Nodes(
            actuated=jnp.ones((batch, count), bool),
            mask=jnp.broadcast_to(jnp.asarray(mask), (batch, count)),
            candidate=jnp.zeros((batch, pairs), bool),
        ),
        steps=jnp.full(batch, states - 1),
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_it_keeps_its_distance_from_every_body_at_every_step(dimension: int) -> None:
    rng = np.random.default_rng(0)
    position = rng.uniform(-0.3, 0.3, size=(200, 1, 3, dimension))
    position = position + rng.uniform(-0.03, 0.03, size=(200, 5, 3, dimension))
    position[:, :, 2] = 0.0
    # The third node is padding, at the origin: it must neither repel nor attract.
    before = windows(position, [True, True, False])
    after = add_distractor(before, NEAREST, FARTHEST, jax.random.key(0))
    place = np.asarray(after.position[:, :, 3])
    assert np.all(place == place[:, :1]), "it rests"
    assert np.all(after.velocity[:, :, 3] == 0.0)
    distance = np.linalg.norm(np.asarray(after.position[:, :, :2]) - place[:, :, None], axis=-1)
    found = np.asarray(after.nodes.mask[:, 3])
    assert found.mean() > 0.5
    assert np.all(distance[found].min(axis=(1, 2)) >= NEAREST - 1e-6)
    assert np.all(distance[found].min(axis=(1, 2)) <= FARTHEST + 1e-6)
    to_padding = np.linalg.norm(place[found, 0], axis=-1)
    assert to_padding.min() < NEAREST, "padding does not repel distractors"
    assert not np.any(after.nodes.actuated[:, 3])
    assert np.all(after.nodes.candidate[:, 3:]), "its edges are candidates"


def test_recorded_nodes_are_unchanged_and_it_has_no_reach() -> None:
    before = windows(np.random.default_rng(1).normal(size=(4, 3, 2, 2)), [True, True])
    reach = jnp.tile(jnp.array([[[-1.0, -1.0], [1.0, 1.0]]]), (4, 2, 1, 1))
    before = before._replace(nodes=before.nodes._replace(reach=reach))
    after = add_distractor(before, NEAREST, FARTHEST, jax.random.key(0))
    np.testing.assert_array_equal(after.position[:, :, :2], before.position)
    np.testing.assert_array_equal(after.velocity[:, :, :2], before.velocity)
    np.testing.assert_array_equal(after.control, before.control)
    np.testing.assert_array_equal(after.nodes.mask[:, :2], before.nodes.mask)
    np.testing.assert_array_equal(after.nodes.actuated[:, :2], before.nodes.actuated)
    np.testing.assert_array_equal(after.nodes.candidate[:, :1], before.nodes.candidate)
    np.testing.assert_array_equal(after.nodes.reach[:, :2], reach)
    assert after.nodes.reach.shape == (4, 3, 2, 2) and np.isnan(after.nodes.reach[:, 2]).all()


@pytest.mark.parametrize(("pieces", "corners"), [(0, 0), (1, 0), (1, 3)])
def test_bodies_may_have_no_outlines(pieces: int, corners: int) -> None:
    """As those of the arm: the array of outlines is then there, and empty."""
    before = windows(np.zeros((4, 3, 2, 2)), [True, True])
    outlines = jnp.zeros((4, 2, pieces, corners, 2))
    before = before._replace(nodes=before.nodes._replace(outlines=outlines))
    after = add_distractor(before, NEAREST, FARTHEST, jax.random.key(0))
    distance = np.linalg.norm(np.asarray(after.position[:, 0, 2]), axis=-1)
    assert np.all((distance >= NEAREST - 1e-6) & (distance <= FARTHEST + 1e-6))
    assert after.nodes.outlines.shape == (4, 3, pieces, corners, 2)


def test_without_space_a_distractor_is_masked() -> None:
    """A body sweeps a square so densely that only its rim is free."""
    line = 0.09 * np.arange(40)
    sweep = np.stack(np.meshgrid(line, line), axis=-1).reshape(1, -1, 1, 2)
    after = add_distractor(
        windows(np.repeat(sweep, 64, axis=0), [True]), NEAREST, 0.11, jax.random.key(0)
    )
    place, exists = np.asarray(after.position[:, 0, 1]), np.asarray(after.nodes.mask[:, 1])
    path = sweep[0, :, 0]
    between = np.linspace(0.0, 1.0, 201)[:, None, None]
    dense = (path[:-1] + between * (path[1:] - path[:-1])).reshape(-1, 2)
    distance = np.array([np.linalg.norm(one - dense, axis=-1).min() for one in place])
    assert 0 < exists.sum() < 64, "eight tries find the rim now and then"
    np.testing.assert_array_equal(exists, distance >= NEAREST - 1e-6)
    assert np.all(after.nodes.mask[:, 0])
    assert np.all(np.isfinite(after.position))


def moving(*speed: float, steps: int = 3) -> Trajectory:
    """Bodies of these speeds, m/s, of which the first is actuated."""
    count = len(speed)
    scene = Scene(tuple("abc"[:count]), ("x",) * count, np.arange(count) == 0, 0.1)
    velocity = np.zeros((steps + 1, count, 2))
    velocity[..., 0] = speed
    return Trajectory(scene, np.zeros_like(velocity), velocity, np.zeros((steps, 1)))


def test_whether_bodies_ever_rest() -> None:
    def resting(*trajectories: Trajectory) -> bool:
        return has_resting_bodies(pad_trajectories(Dataset(trajectories)))

    assert resting(moving(1.0, 0.0))
    assert not resting(moving(1.0, 0.5))
    assert not resting(moving(0.0, 0.5)), "an actuated body that waits says nothing"
    longer = moving(1.0, 1.0, 1.0, steps=8)
    assert not resting(moving(0.0, 0.5), longer), "padding is not a resting body"
