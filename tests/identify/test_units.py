"""Units: the same motion in metres or millimetres is the same training and the same model."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.cli.models import facts_text
from contactgraph.data import Dataset, InvalidInputError, Scene, Trajectory
from contactgraph.identify import Units, fit_actuation, identify, in_units
from contactgraph.identify.facts import units_of
from contactgraph.model import ModelState, ours, scene_nodes

STEPS, DT = 40, 0.04
LENGTHS, COMMANDS = 1000.0, np.array([20.0, 20.0, 0.1])


def recorded(seed: int) -> Trajectory:
    """A hand with fingers that pushes a block along the first axis, and is lifted; metres."""
    rng = np.random.default_rng(seed)
    position = np.zeros((STEPS + 1, 2, 2))
    position[0] = [[0.0, 0.0], [0.2, 0.02]]
    control = np.hstack(
        [rng.uniform(-0.01, [0.03, 0.01], (STEPS, 2)), rng.uniform(-1.0, 1.0, (STEPS, 1))]
    )
    for step in range(STEPS):
        hand = position[step, 0] + 0.7 * control[step, :2]
        block = position[step, 1]
        pushed = max(0.0, 0.08 - np.linalg.norm(hand - block)) * (hand[0] < block[0])
        position[step + 1] = [hand, block + np.array([pushed, 0.0])]
    velocity = np.concatenate([np.zeros_like(position[:1]), np.diff(position, axis=0) / DT])
    scene = Scene(
        ("hand", "block"),
        ("hand", "block"),
        np.array([True, False]),
        DT,
        goal=np.array([0.4, 0.0]),
        gravity=np.array([0.0, -9.81]),
        control_kind=("displacement", "displacement", "other"),
        planes=np.array([[0.0, 1.0, -0.05]]),
        reach=np.array([[[-1.0, np.nan], [1.0, np.nan]], np.full((2, 2), np.nan)]),
    )
    return Trajectory(scene, position, velocity, control)


METRES = Dataset(tuple(recorded(seed) for seed in range(6)))
OTHER = in_units(METRES, Units(1.0 / LENGTHS, tuple(1.0 / COMMANDS)))


def test_a_training_sees_the_same_numbers_whatever_the_units() -> None:
    metres, other = identify(METRES), identify(OTHER)
    assert (metres.units.length, other.units.length) == (1.0, LENGTHS)
    scaled = in_units(METRES, metres.units), in_units(OTHER, other.units)
    for one, two in zip(*scaled, strict=True):
        for name in ("position", "velocity", "control"):
            expected = getattr(one, name).astype(np.float32)
            np.testing.assert_array_equal(getattr(two, name).astype(np.float32), expected)
        np.testing.assert_allclose(two.scene.planes, one.scene.planes, rtol=1e-12)
        np.testing.assert_allclose(two.scene.reach, one.scene.reach, rtol=1e-12)
        np.testing.assert_allclose(two.scene.gravity, one.scene.gravity, rtol=1e-12)
    assert other.config.contact_distance == pytest.approx(metres.config.contact_distance)
    assert "1000 of the data" in facts_text("ours", other)


def test_facts_in_the_units_of_the_data_are_those_that_the_data_tell() -> None:
    metres, other = identify(METRES).in_data, identify(OTHER).in_data
    in_metres, in_other = (fit_actuation(each, 1.0)["hand"] for each in (METRES, OTHER))
    for found, expected in ((metres, in_metres), (other, in_other)):
        size = abs(expected.matrix).max()
        error = found.actuation["hand"].matrix - expected.matrix
        np.testing.assert_allclose(error, 0.0, atol=1e-9 * size)
        assert found.actuation["hand"].damping == pytest.approx(expected.damping)
    assert other.contact_distance == pytest.approx(LENGTHS * metres.contact_distance)
    assert other.plane_distance["block"] == pytest.approx(LENGTHS * metres.plane_distance["block"])
    assert (metres.speed, other.speed) == (1.0, LENGTHS)


@pytest.mark.usefixtures("double_precision")
def test_a_model_predicts_the_same_motion_in_the_units_of_its_data() -> None:
    """Weights as after training: every array moved at random. In double precision, because contacts
    enlarge rounding."""
    found = [identify(each) for each in (METRES, OTHER)]
    fresh = ours(found[0].config, key=jax.random.key(0))
    arrays, static = eqx.partition(fresh, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(arrays)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    moved = [
        leaf + 0.05 * jax.random.normal(k, leaf.shape) for leaf, k in zip(leaves, keys, strict=True)
    ]
    trained = eqx.combine(jax.tree.unflatten(tree, moved), static)
    rollout = eqx.filter_jit(lambda model, *given: model.rollout(*given))
    ends = []
    for facts, data, length in ((found[0], METRES, 1.0), (found[1], OTHER, LENGTHS)):
        model = facts.in_data_units(trained, ours)
        each = data.trajectories[0]
        nodes = scene_nodes(each.scene)
        start = jnp.asarray(each.position[9]), jnp.asarray(each.velocity[9])
        state = ModelState(*start, model.initial_belief(*start, nodes))
        states = rollout(model, state, jnp.asarray(each.control[9:]), nodes)
        scales = model.prediction_noise.position / length, model.prediction_noise.velocity / length
        ends.append((states.position / length, states.velocity / length, *scales))
        assert np.ptp(states.position[:, 1, 0]) > 1e-3 * length, "the block is pushed"
        ends[-1] += (states.belief.type_probability,)
    for one, two in zip(*ends, strict=True):
        np.testing.assert_allclose(two, one, rtol=1e-8, atol=1e-10)


def test_units_are_positive_numbers() -> None:
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InvalidInputError, match="units must be positive"):
            Units(wrong)
    still = replace(recorded(0), control=np.zeros((STEPS, 3)))
    assert units_of(Dataset((still,)), 85.0, 0.085) == Units(1000.0, (1.0, 1.0, 1.0))
