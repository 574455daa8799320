"""The interaction network: its symmetries, its training, and the baselines that are fitted."""

import itertools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_worlds import DT, random_run, scene_of

from contactgraph.data import Dataset, InvalidInputError, Trajectory
from contactgraph.evaluate.baselines import constant_velocity
from contactgraph.evaluate.interaction_network import InteractionNetwork, links
from contactgraph.evaluate.network_fit import (
    FittedNetwork,
    fit_baselines,
    fit_interaction_network,
    input_scales,
    network_windows,
)
from contactgraph.model import scene_nodes

TYPES = ("gripper", "object")


def attraction(seed: int, steps: int = 30) -> Trajectory:
    """A driven body that pulls another by a spring."""
    rng = np.random.default_rng(seed)
    position, velocity = 0.3 * rng.normal(size=(2, 2)), 0.3 * rng.normal(size=(2, 2))
    control = np.repeat(rng.normal(size=(steps // 10 + 1, 2)), 10, axis=0)[:steps]
    states = [(position, velocity)]
    for force in control:
        pull = 8.0 * (position[0] - position[1])
        velocity = velocity + DT * np.stack([force, pull])
        position = position + DT * velocity
        states.append((position, velocity))
    positions, velocities = map(np.stack, zip(*states, strict=True))
    return Trajectory(scene_of(2), positions, velocities, control)


@pytest.fixture(scope="module")
def network():
    """Untrained, but with an answer that is not constant velocity."""
    run = random_run(3, 8, 0)
    scales = input_scales(Dataset((run,)))
    made = InteractionNetwork(2, TYPES, scales, jax.random.key(0))
    return eqx.tree_at(lambda each: each.decoder.weight, made, replace_fn=lambda leaf: 100 * leaf)


_step = eqx.filter_jit(lambda network, *arguments: network.step(*arguments))


def step(network, run: Trajectory, capacity: int | None = None):
    count = run.scene.node_count
    scene = scene_nodes(run.scene, capacity)
    padding = ((0, (capacity or count) - count), (0, 0))
    arrays = (np.pad(each[0], padding) for each in (run.position, run.velocity))
    found = _step(network, scene, *(jnp.asarray(each) for each in arrays), run.control[0])
    return [np.asarray(each)[:count] for each in found]


def test_padding_and_order_change_nothing(network):
    run = random_run(3, 8, 0)
    own = step(network, run)
    assert np.abs(own[0] - run.position[0]).max() > 0.01
    for found, expected in zip(step(network, run, 5), own, strict=True):
        assert np.allclose(found, expected, atol=1e-5)
    order = [0, 2, 1]
    moved = replace(run, position=run.position[:, order], velocity=run.velocity[:, order])
    for found, expected in zip(step(network, moved), own, strict=True):
        assert np.allclose(found, expected[order], atol=1e-5)


def test_control_reaches_what_it_acts_on_and_messages_only_candidates(network):
    run = random_run(3, 8, 0)
    alone = replace(run, scene=replace(run.scene, candidate_edges=np.zeros((0, 2), int)))
    pushed = replace(alone, control=alone.control + 1.0)
    differs = [np.abs(one - other).max(axis=1) for one, other in zip(
        step(network, alone), step(network, pushed), strict=True)]  # fmt: skip
    assert all(each[0] > 1e-4 and not each[1:].any() for each in differs)
    together = replace(run, control=alone.control + 1.0)
    assert np.abs(step(network, run)[0] - step(network, together)[0])[1].max() > 1e-5
    acts = np.array([[False] * 2, [True] * 2, [False] * 2])
    second = replace(alone.scene, actuated=np.array([True, True, False]), control_of=acts)
    still, moved = (step(network, replace(each, scene=second))[0] for each in (alone, pushed))
    found = np.abs(moved - still).max(axis=1)
    assert found[0] == found[2] == 0.0 < found[1]


def test_a_static_body_stays(network):
    run = random_run(3, 8, 0)
    still = run.velocity.copy()
    still[:, 1] = 0.0
    fixed = replace(run.scene, static=np.array([False, True, False]))
    position, velocity = step(network, replace(run, velocity=still, scene=fixed))
    assert np.allclose(position[1], run.position[0, 1]) and not velocity[1].any()
    assert velocity[0].any()


def test_a_distractor_is_linked_to_all_that_exist_and_to_nothing_else():
    quiet, other = random_run(2, 12, 0), random_run(3, 12, 1)
    runs = []
    for run in (quiet, other):
        velocity = run.velocity.copy()
        velocity[:, 1] = 0.0
        runs.append(replace(run, velocity=velocity))
    windows = network_windows(Dataset(tuple(runs)))
    assert windows.distractors == 1
    nodes = jax.jit(lambda key: windows.draw(16, key))(jax.random.key(3)).nodes
    mask = np.asarray(nodes.mask)
    assert mask.shape == (16, 4) and mask[:, -1].any() and not mask[:, 2].all()
    linked = np.asarray(jax.vmap(links)(nodes))
    expected = mask[:, :, None] & mask[:, None] & ~np.eye(4, dtype=bool)
    assert np.array_equal(linked, expected)
    types = np.asarray(nodes.type_id)
    assert np.array_equal(types[:, -1], types[:, 1])  # an object, not a gripper
    assert not np.asarray(nodes.actuated)[:, -1].any()


@pytest.fixture(scope="module")
def fitted():
    """Least squares and a network, by a clock that ticks once every 50 steps of training."""
    data = Dataset(tuple(attraction(seed) for seed in range(16)))

    def fit(dataset: Dataset, seconds: float, least_steps: int):
        tick = itertools.count()
        clock = lambda: float(next(tick))  # noqa: E731
        return fit_interaction_network(dataset, seconds, least_steps, clock=clock)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("contactgraph.evaluate.network_fit.fit_interaction_network", fit)
        patch.setattr("contactgraph.evaluate.network_fit._BATCH", 8)
        patch.setattr("contactgraph.evaluate.network_fit._CHECKED", 8)
        return fit_baselines(data, Dataset((random_run(3, 8, 0),)), 2.0, 150)


def test_bodies_that_turn_have_angles_whatever_the_number_of_turns() -> None:
    """Of two boxes, one spins; untrained, the network keeps them spinning."""
    square = 0.1 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    run = random_run(2, 8, 0)
    scene = replace(run.scene, polygons=(square, square), polygon_of=np.arange(2))
    rate = np.array([[3.0], [0.0]])
    turn = rate * DT * np.arange(9)[:, None, None]
    spin = np.broadcast_to(rate, turn.shape)
    run = replace(run, scene=scene, orientation=turn, angular_velocity=spin)
    scales = input_scales(Dataset((run,)))
    assert scales.turn_length == pytest.approx(np.sqrt(0.2**2 / 6.0))
    fitted = FittedNetwork(InteractionNetwork(2, TYPES, scales, jax.random.key(0)), 0.0, 0)
    found = fitted(run, 4)
    assert found.shape == (5, 4, 2, 3)
    expected = np.stack([turn[start + 1 : start + 5] for start in range(5)])[..., 0]
    assert np.abs(found[..., 2] - expected).max() < 0.05 < np.ptp(found[..., 2])
    again = fitted(replace(run, orientation=turn + 2.0 * np.pi), 4)
    np.testing.assert_allclose(again[..., :2], found[..., :2], atol=1e-5)
    np.testing.assert_allclose(again[..., 2], found[..., 2] + 2.0 * np.pi, atol=1e-5)


def test_it_learns_a_spring_between_two_bodies(fitted):
    fresh = attraction(99)
    truth = np.stack([fresh.position[start + 1 : start + 7] for start in range(25)])
    least_squares, network = fitted
    error, exact, floor = (
        np.sqrt(np.mean((each(fresh, 6) - truth) ** 2))
        for each in (network, least_squares, constant_velocity)
    )
    assert error < 0.4 * floor and exact < 1e-3 * floor


def test_the_effort_of_training_and_the_reason_of_a_null_are_told(fitted):
    least_squares, network = fitted
    three = random_run(3, 8, 0)
    assert (network.seconds, network.steps) == (3.0, 150)
    assert least_squares.missing([three]) == (
        "no scene of the training data has 3 nodes, as the test data has; they have 2"
    )
    assert least_squares(three, 2) is None
    assert network(three, 2).shape == (7, 2, 3, 2)


def test_baselines_are_fitted_to_data_of_the_same_kind_only():
    data = Dataset((attraction(0), attraction(1)))
    slower = Dataset((replace(attraction(2), scene=replace(scene_of(2), dt=0.1)),))
    message = r"must have the dt of the test data, 0\.1, found 0\.05"
    with pytest.raises(InvalidInputError, match=message):
        fit_baselines(data, slower, 1.0, 1)
    more = Dataset((replace(attraction(2), control=np.zeros((30, 3))),))
    with pytest.raises(InvalidInputError, match="control_size of the test data, 3, found 2"):
        fit_baselines(data, more, 1.0, 1)
