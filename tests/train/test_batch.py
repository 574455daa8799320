"""Windows: sampling rates, agreement with their trajectories, batches split over devices."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Scene,
    Trajectory,
    pad_trajectories,
    window_weights,
)
from contactgraph.train.batch import (
    WindowSource,
    add_distractor,
    batch_split,
    has_resting_bodies,
    window_source,
)

draw = eqx.filter_jit(WindowSource.draw)
take = eqx.filter_jit(WindowSource.take)


def run(count: int, steps: int, offset: float) -> Trajectory:
    """Every number tells run and step: position is offset + step."""
    scene = Scene(tuple("abcd"[:count]), ("x",) * count, np.arange(count) == 0, 0.1)
    position = np.broadcast_to(
        offset + np.arange(steps + 1.0)[:, None, None], (steps + 1, count, 2)
    )
    velocity = np.zeros((steps + 1, count, 2))
    if count > 2:
        velocity[3:, 1] = 1.0  # an event in the step from state 2 to state 3
    return Trajectory(scene, position, velocity, np.full((steps, 1), offset))


@pytest.fixture(scope="module")
def padded():
    return pad_trajectories(Dataset((run(2, 5, 100.0), run(3, 8, 200.0))))


def test_windows_are_drawn_as_often_as_given(padded) -> None:
    windows = window_weights(padded, 3, 0.6)
    assert windows.has_event.any() and not windows.has_event.all()
    drawn = draw(window_source(padded, 3, 0.6), 20_000, jax.random.key(0))
    number = np.asarray(drawn.position[:, 0, 0, 0])
    expected = np.where(windows.trajectory == 0, 100.0, 200.0) + windows.start
    assert set(number) == set(expected)
    found = np.array([(number == each).mean() for each in expected])
    np.testing.assert_allclose(found, windows.probability, atol=0.012)
    assert found[windows.has_event].sum() == pytest.approx(0.6, abs=0.012)


def test_a_window_is_a_section_of_its_trajectory(padded) -> None:
    windows = window_weights(padded, 3, 0.6)
    batch = take(window_source(padded, 3, 0.6), windows.trajectory, windows.start)
    for index, (number, start) in enumerate(zip(windows.trajectory, windows.start, strict=True)):
        for name, end in (("position", 4), ("velocity", 4), ("control", 3)):
            expected = getattr(padded, name)[number, start : start + end]
            np.testing.assert_array_equal(getattr(batch, name)[index], expected, err_msg=name)
        np.testing.assert_array_equal(batch.nodes.mask[index], padded.nodes.mask[number])
        np.testing.assert_array_equal(batch.nodes.actuated[index], padded.nodes.actuated[number])
        np.testing.assert_array_equal(batch.nodes.candidate[index], padded.nodes.candidate[number])


def test_hinges_go_with_their_trajectories(padded) -> None:
    free, hung = run(2, 5, 100.0), run(3, 8, 200.0)
    anchor = np.array([[np.nan, np.nan], [0.3, 0.4], [np.nan, np.nan]])
    hung = dataclasses.replace(hung, scene=dataclasses.replace(hung.scene, anchor=anchor))
    runs = pad_trajectories(Dataset((free, hung)))
    windows = window_weights(runs, 3, 0.6)
    nodes = take(window_source(runs, 3, 0.6), windows.trajectory, windows.start).nodes
    hinged = np.asarray(jax.vmap(lambda nodes: nodes.hinged)(nodes))
    np.testing.assert_array_equal(hinged, (windows.trajectory == 1)[:, None] & [False, True, False])
    np.testing.assert_allclose(nodes.anchor[hinged], np.tile(anchor[1], (hinged.sum(), 1)))
    assert window_source(padded, 3, 0.6).trajectories.nodes.anchor is None


def test_static_bodies_go_with_their_trajectories(padded) -> None:
    scene = dataclasses.replace(run(3, 8, 200.0).scene, static=np.array([False, False, True]))
    pillar = dataclasses.replace(run(3, 8, 200.0), scene=scene)
    dataset = Dataset((run(2, 5, 100.0), pillar))
    static = pad_trajectories(dataset, node_capacity=4).nodes.static
    np.testing.assert_array_equal(static, [[False] * 4, [False, False, True, False]])
    assert pad_trajectories((run(2, 5, 100.0),)).nodes.static is None
    windows = window_weights(padded, 3, 0.6)
    source = window_source(pad_trajectories(dataset), 3, 0.6)
    taken = take(source, windows.trajectory, windows.start)
    second = (windows.trajectory == 1)[:, None]
    np.testing.assert_array_equal(taken.nodes.static, second & [False, False, True])
    two_bodies, with_pillar = [True, True, False], [True, True, False]
    np.testing.assert_array_equal(taken.nodes.mobile, [two_bodies] * 3 + [with_pillar] * 6)
    plain = take(window_source(padded, 3, 0.6), windows.trajectory, windows.start)
    assert plain.nodes.static is None
    np.testing.assert_array_equal(plain.nodes.mobile, padded.nodes.mask[windows.trajectory])
    among = eqx.filter_jit(add_distractor)(taken, 1e6, 2e6, jax.random.key(0))
    np.testing.assert_array_equal(among.nodes.mobile[:, :3], taken.nodes.mobile)
    assert np.all(among.nodes.mobile[:, 3]), "the added body rests, but could move"


def test_a_static_body_is_no_resting_body() -> None:
    moving = run(3, 8, 200.0)
    moving = dataclasses.replace(moving, velocity=moving.velocity + np.array([1.0, 0.0]))
    rests = moving.velocity.copy()
    rests[:, 2] = 0.0
    rests = dataclasses.replace(moving, velocity=rests)
    assert not has_resting_bodies(pad_trajectories((moving,)))
    batch = pad_trajectories((rests,))
    assert has_resting_bodies(batch)
    for static, expected in (([False, False, True], False), ([False, True, False], True)):
        nodes = batch.nodes._replace(static=np.array([static]))
        assert has_resting_bodies(batch._replace(nodes=nodes)) == expected


def test_training_reads_no_contact_labels() -> None:
    labelled = run(3, 8, 200.0)
    contact = np.ones((9, 3, 3), dtype=bool)
    padded = pad_trajectories((dataclasses.replace(labelled, contact=contact),))
    assert padded.contact is not None
    zeros = np.zeros(2, int)
    assert take(window_source(padded, 3, 0.6), zeros, zeros).contact is None


PROGRAM = Path(__file__).with_name("on_devices.py")


@pytest.mark.slow
def test_four_devices_train_what_one_trains(recorded: Path) -> None:
    """Double precision: in single precision, Adam makes whole steps of mere rounding errors."""
    finished = subprocess.run(
        [sys.executable, "-W", "error", str(PROGRAM), str(recorded)],
        env={
            **os.environ,
            "JAX_ENABLE_X64": "1",
            "JAX_PLATFORMS": "cpu",
            "XLA_FLAGS": "--xla_force_host_platform_device_count=4",
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    devices, moved, apart, error_apart = map(float, finished.stdout.split())
    assert devices == 4
    assert moved > 1e-3
    assert apart < 1e-8 and error_apart < 1e-8


def test_one_device_splits_nothing() -> None:
    for devices in ((), jax.local_devices()[:1]):
        split, batch = batch_split(devices, 7), np.arange(7)
        assert split.parts == 1
        assert split.shard(batch) is batch and split.replicate(batch) is batch


def test_a_batch_that_does_not_come_out_even() -> None:
    with pytest.raises(InvalidInputError, match="a batch of 32 windows cannot be split evenly ove"):
        batch_split(jax.local_devices()[:1] * 3, 32)
