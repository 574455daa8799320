r"""The rigid motion that explains best where points were seen.

Of :math:`T` (object to camera), with points :math:`p_i` on the object, seen at :math:`y_i` across
the direction :math:`n_i` with a standard deviation :math:`\sigma_i`:

.. math:: \min_T \sum_i \rho\left(n_i \cdot (y_i - \pi(T p_i)) / \sigma_i\right)

by Gauss and Newton's method with Huber's :math:`\rho`.
"""

from dataclasses import dataclass

import numpy as np

from contactgraph_franka.perception.rigid import nearest_rotation, pose, rotation_of

_HUBER = 3.0
"""Standard deviations beyond which an error counts less than squared: an edge half hidden."""
_STEPS = 15
_SETTLED = 1e-6
"""rad and m: a step as short as this is the last."""
_LONGEST_TURN = 0.5
"""rad, of a step: a start that is far off must not be thrown farther."""
_LEAST_INFORMATION = 1e-3
"""Of turns [1/rad^2] and positions [1/m^2]: what nothing was seen of is known to 30 rad and m."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Points of an object in a picture, ``M`` of them; each one is known across one direction."""

    points: np.ndarray
    """[M, 3] m, in the object's frame."""
    rays: np.ndarray
    """[M, 2]: x/z and y/z in the camera's frame."""
    across: np.ndarray
    """[M, 2]: directions in the plane of ``rays``, over the standard deviation along them."""


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A rigid motion, and how well it explains what was seen."""

    pose: np.ndarray
    """[4, 4]: object to camera."""
    information: np.ndarray
    """[6, 6]: the covariance's inverse; a small turn about the object's origin [rad] first, then a
    small move [m], both along the camera's axes."""
    loss: float
    """The sum that was made small; infinite where the object would be behind the camera."""
    residual: np.ndarray
    """[M], in standard deviations."""


def fit_pose(start: np.ndarray, seen: Seen) -> PoseFit:
    """The motion [4, 4] that explains ``seen`` best, near ``start`` [4, 4]."""
    turn, place = start[:3, :3], start[:3, 3]
    for _ in range(_STEPS):
        residual, jacobian = _linearised(turn, place, seen)
        weight = _HUBER / np.maximum(np.abs(residual), _HUBER)
        step = np.linalg.solve(
            jacobian.T @ (weight[:, None] * jacobian) + _LEAST_INFORMATION * np.eye(6),
            jacobian.T @ (weight * residual),
        )
        step *= min(1.0, _LONGEST_TURN / max(float(np.linalg.norm(step[:3])), 1e-12))
        turn, place = rotation_of(step[:3]) @ turn, place + step[3:]
        if np.abs(step).max() < _SETTLED:
            break
    residual, jacobian = _linearised(turn, place, seen)
    length = np.abs(residual)
    weight = _HUBER / np.maximum(length, _HUBER)
    loss = np.where(length < _HUBER, length**2, _HUBER * (2.0 * length - _HUBER)).sum()
    in_front = np.isfinite(loss) and place[2] > 0.0
    return PoseFit(
        pose(nearest_rotation(turn), place) if in_front else start,
        jacobian.T @ (weight[:, None] * jacobian) + _LEAST_INFORMATION * np.eye(6),
        float(loss) if in_front else np.inf,
        residual,
    )


def _linearised(turn: np.ndarray, place: np.ndarray, seen: Seen) -> tuple[np.ndarray, np.ndarray]:
    """Residuals [M] in standard deviations, and their slopes [M, 6] by turn and move."""
    turned = seen.points @ turn.T
    moved = turned + place
    depth = moved[:, 2:]
    rays = moved[:, :2] / depth
    across = seen.across
    by_move = np.concatenate([across, -(across * rays).sum(axis=1, keepdims=True)], axis=1) / depth
    # A turn w moves a point by w x (R p): its slope is (R p) x (slope by the move).
    by_turn = np.stack(
        [
            turned[:, 1] * by_move[:, 2] - turned[:, 2] * by_move[:, 1],
            turned[:, 2] * by_move[:, 0] - turned[:, 0] * by_move[:, 2],
            turned[:, 0] * by_move[:, 1] - turned[:, 1] * by_move[:, 0],
        ],
        axis=1,
    )
    residual = ((seen.rays - rays) * across).sum(axis=1)
    return residual, np.concatenate([by_turn, by_move], axis=1)
