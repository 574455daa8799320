"""Turns of recorded bodies: angles in the plane, quaternions and rotation vectors in space."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_SMALL = 1e-9


def coordinate_count(dimension: int, turn_length: float | None) -> int:
    """G, the coordinates of a body of `generalized_coordinates`."""
    return dimension if turn_length is None else 3 * (dimension - 1)


def generalized_coordinates(
    turn_length: float | None,
    position: np.ndarray,
    velocity: np.ndarray,
    orientation: np.ndarray | float = np.nan,
    angular_velocity: np.ndarray | float = np.nan,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions [..., G] m and velocities [..., G] m/s of bodies, with their turn in lengths.

    The first D are those given. Then come, unless ``turn_length`` [m] is None, the angle [rad] in
    the plane times that length, and its rate; in space the `rotation_vectors` times that length,
    and the angular velocity about the body's own axes. They are NaN where they are not known.
    """
    if turn_length is None:
        return position, velocity
    dimension = position.shape[-1]
    size = coordinate_count(dimension, 1.0) - dimension
    bodies = position.shape[:-1]
    turn = np.broadcast_to(orientation, (*bodies, 4 if dimension == 3 else size))
    rate = np.broadcast_to(angular_velocity, (*bodies, size))
    if dimension == 3:
        turn = rotation_vectors(turn)
        rate = turned_by(-turn, rate)
    return (
        np.concatenate([position, turn_length * turn], axis=-1),
        np.concatenate([velocity, turn_length * rate], axis=-1),
    )


def rotation_vectors(orientation: np.ndarray) -> np.ndarray:
    """[..., 3] rad, of unit quaternions (w, x, y, z); NaN stays.

    Along the first axis of an array [T, N, 4], time, they continue without jumps, beyond half a
    turn. Whole turns make no difference, so that the first and those of other arrays are at most
    half a turn.
    """
    flipped = np.where(orientation[..., :1] < 0.0, -orientation, orientation)
    scalar, vector = flipped[..., :1], flipped[..., 1:]
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = np.where(length > _SMALL, vector / length, 0.0)
    turn = 2.0 * np.arctan2(length, scalar) * unit
    if turn.ndim == 3:
        for step in range(1, len(turn)):
            turn[step] = near_turn(turn[step], turn[step - 1])
    return np.asarray(turn)


def continued_angles(angle: np.ndarray, rate: np.ndarray, dt: float) -> np.ndarray:
    """[T+1, ...] rad: equal angles that go on without jumps of whole turns.

    Each is the one nearest to the angle before and its ``rate`` [T+1, ...] rad/s, so that bodies
    may turn by more than half a turn in a step. NaN stays, and is passed over; of a rate it is 0.
    """
    found = angle.copy()
    for index in np.ndindex(angle.shape[1:]):
        of_node = found[(slice(None), *index)]
        known = np.flatnonzero(np.isfinite(of_node))
        speed = np.nan_to_num(rate[(slice(None), *index)])
        expected = speed[known[1:]] * dt * np.diff(known)
        turns = np.round((expected - np.diff(of_node[known])) / (2.0 * np.pi))
        of_node[known[1:]] += 2.0 * np.pi * np.cumsum(turns)
    return angle if np.array_equal(found, angle, equal_nan=True) else found


def near_turn(turn: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[..., 3] rad: of the rotation vectors that are equal to ``turn``, the nearest to another."""
    length, far = (np.linalg.norm(each, axis=-1, keepdims=True) for each in (turn, other))
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.where(length > _SMALL, turn / length, np.where(far > _SMALL, other / far, 0.0))
    whole = np.round(np.sum((other - turn) * axis, axis=-1, keepdims=True) / (2.0 * np.pi))
    return turn + 2.0 * np.pi * np.nan_to_num(whole) * axis


def turned_by(turn: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """[..., 3] vectors, turned by rotation vectors ``turn`` [..., 3] rad."""
    axis, angle = _axis_and_angle(turn)
    across = np.cross(axis, vector)
    return np.asarray(
        vector + np.sin(angle) * across + (1.0 - np.cos(angle)) * np.cross(axis, across)
    )


def _axis_and_angle(turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[..., 3], [..., 1] rad; the axis is 0 where nothing turns."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(angle > 0.0, turn / angle, 0.0), angle


def quaternions(turn: np.ndarray) -> np.ndarray:
    """[..., 4] unit quaternions (w, x, y, z) of rotation vectors [..., 3] rad."""
    axis, angle = _axis_and_angle(turn)
    return np.concatenate([np.cos(0.5 * angle), np.sin(0.5 * angle) * axis], axis=-1)


def turn_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[...] rad, at least 0: the angle of the turn from one orientation to another, which are
    angles [..., 1] in the plane and rotation vectors [..., 3] in space; NaN stays."""
    if one.shape[-1] == 1:
        return np.abs(one - other)[..., 0]
    between = _product(quaternions(-one), quaternions(other))
    length = np.linalg.norm(between[..., 1:], axis=-1)
    return np.asarray(2.0 * np.arctan2(length, np.abs(between[..., 0])))


def turned_on(turn: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Orientations, as in `turn_between`, of bodies that turn on ``by`` about their own axes."""
    if turn.shape[-1] == 1:
        return turn + by
    return rotation_vectors(_product(quaternions(turn), quaternions(by))[None])[0]


def angular_velocity(before: np.ndarray, after: np.ndarray, dt: float) -> np.ndarray:
    """The constant angular velocity ``[N, 1 or 3]`` rad/s from one orientation to the next.

    In space orientations are unit quaternions ``[N, 4]`` (w, x, y, z); it is in world axes, and the
    shorter of the two ways.
    """
    if before.shape[1] != 4:
        return (after - before) / dt
    return rotation_vectors(_product(after, before * [1.0, -1.0, -1.0, -1.0])) / dt


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[..., 4] (w, x, y, z): the product of two quaternions."""
    (one, left), (other, right) = (np.split(each, [1], axis=-1) for each in (first, second))
    scalar = one * other - np.sum(left * right, axis=-1, keepdims=True)
    vector = one * right + other * left + np.cross(left, right)
    return np.concatenate([scalar, vector], axis=-1)


def rotations(quaternion: np.ndarray) -> "Rotation":
    """Of ``[..., 4]`` (w, x, y, z); SciPy's own order is (x, y, z, w)."""
    from scipy.spatial.transform import Rotation  # slow to import

    return Rotation.from_quat(np.roll(quaternion, -1, axis=-1))


def quaternions_of(rotation: "Rotation") -> np.ndarray:
    """``[..., 4]`` (w, x, y, z): the inverse of `rotations`."""
    return np.roll(rotation.as_quat(), 1, axis=-1)
