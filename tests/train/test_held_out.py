"""The held-out error by hand: bodies that rest, and padding, do not count."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.data import Dataset, Scene, Trajectory, pad_trajectories
from contactgraph.train.batch import window_source
from contactgraph.train.held_out import HeldOutWindows, held_out_windows, mean_rmse

DT = 0.1


def held_out(
    *positions: np.ndarray, velocity: float = 0.0, static: np.ndarray | None = None
) -> HeldOutWindows:
    """One window a trajectory [T+1, N, 1], all of one length, drawn many times."""

    def trajectory(position: np.ndarray) -> Trajectory:
        names = tuple(f"body-{node}" for node in range(position.shape[1]))
        free = np.zeros(len(names), bool)
        scene = Scene(names, names, free, DT, dimension=1, static=static)
        control = np.zeros((len(position) - 1, 0))
        return Trajectory(scene, position, np.full_like(position, velocity), control)

    batch = pad_trajectories(Dataset(tuple(map(trajectory, positions))), contacts=False)
    return held_out_windows(window_source(batch, len(positions[0]) - 1, 0.0))


def path(*bodies: list[float]) -> np.ndarray:
    """[T+1, N, 1] m from each body's positions."""
    return np.array(bodies, float).T[..., None]


def test_only_bodies_that_move_more_than_a_millimetre_count() -> None:
    moves_and_returns, creeps, rests = [0.0, 0.002, 0.0], [1.0, 1.0009, 1.0], [2.0, 2.0, 2.0]
    found = held_out(path(moves_and_returns, creeps, rests))
    assert found.moving
    np.testing.assert_array_equal(found.counted, [[True, False, False]] * len(found.counted))


def test_padding_never_counts() -> None:
    found = held_out(path([0.0, 0.1], [0.0, 0.0]), path([0.0, 0.5]))
    assert found.moving
    assert {tuple(each) for each in np.asarray(found.counted).tolist()} == {(True, False)}
    found = held_out(path([0.0, 0.0], [3.0, 3.0]), path([1.0, 1.0]))
    assert not found.moving, "where nothing moves, all bodies that exist count"
    assert {tuple(each) for each in np.asarray(found.counted).tolist()} == {
        (True, True),
        (True, False),
    }


def test_static_bodies_never_count() -> None:
    shaken, moves = [0.0, 0.1, 0.0], [1.0, 1.5, 1.0]
    static = np.array([True, False])
    found = held_out(path(shaken, moves), static=static)
    np.testing.assert_array_equal(found.counted, [[False, True]] * len(found.counted))
    found = held_out(path([0.0, 0.0, 0.0], [1.0, 1.0, 1.0]), static=static)
    assert not found.moving
    np.testing.assert_array_equal(found.counted, [[False, True]] * len(found.counted))


def test_the_baselines_by_hand() -> None:
    # 1 m/s for 0.1 s a step: 0.1 and 0.2 m, recorded 0.3 and 0.2 m; the second body rests.
    found = held_out(path([0.0, 0.3, 0.2], [5.0, 5.0, 5.0]), velocity=1.0).baselines(DT)
    assert found.constant_velocity_rmse_m == pytest.approx(math.sqrt((0.2**2 + 0.0) / 2))
    assert found.standing_still_rmse_m == pytest.approx(math.sqrt((0.3**2 + 0.2**2) / 2))
    assert found.moving


def test_the_mean_is_over_the_windows_in_which_a_body_counts() -> None:
    squared = jnp.array([[[4.0, 9.0]], [[16.0, 25.0]], [[1.0, 1.0]]])
    counted = jnp.array([[True, False], [True, True], [False, False]])
    found = float(mean_rmse(squared, counted))
    assert found == pytest.approx((2.0 + math.sqrt(41.0 / 2)) / 2)
    assert float(mean_rmse(squared, jnp.zeros((3, 2), bool))) == 0.0
