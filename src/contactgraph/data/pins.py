"""Pins of recorded scenes: joints of two bodies in the plane, which let them turn."""

from collections.abc import Sequence

import numpy as np


def pin_gaps(
    pins: np.ndarray, pin_points: np.ndarray, position: np.ndarray, angle: np.ndarray
) -> np.ndarray:
    """[..., P] m: distance between the two points of each pin of bodies at ``position`` [..., N, 2]
    m and ``angle`` [..., N] rad."""
    turn = angle[..., pins, None]
    x, y = pin_points[..., :1], pin_points[..., 1:]
    arm = np.concatenate(
        [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)], axis=-1
    )
    ends = position[..., pins, :] + arm
    return np.asarray(np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=-1))


def pinned_group(pins: np.ndarray | None, count: int) -> np.ndarray:
    """[N, N] bool: whether pins join two of ``count`` nodes, directly or through others; False of a
    node with itself."""
    group = np.eye(count, dtype=bool)
    for _ in range(count):
        for first, second in [] if pins is None else pins.tolist():
            group[first] = group[second] = group[first] | group[second]
    return group & ~np.eye(count, dtype=bool)


def pinned_motion(
    velocity: np.ndarray, group: np.ndarray, node_type: Sequence[str], names: Sequence[str]
) -> np.ndarray:
    """[T, D, 2K] m/s: changes of velocity, then velocities [T+1, N, D], summed over the bodies of
    each of the K types ``names`` in a ``group`` [N]; forces at pins cancel in their momentum."""
    both = np.diff(velocity, axis=0), velocity[:-1]
    alike = [group & (np.array(node_type) == name) for name in names]
    sums = [each[:, of].sum(axis=1) for each in both for of in alike]
    return np.stack(sums, axis=-1) if sums else np.zeros((*both[0][:, 0].shape, 0))
