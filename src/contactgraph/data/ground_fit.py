"""Least squares of how the ground slows bodies that slide by themselves, before any training."""

from collections.abc import Iterable

import numpy as np

from contactgraph.data.trajectory import Trajectory

_CLEAR = 1.1
"""Contact distances from the nearest body at which a body slides by itself."""
_PARTS = 0.02
"""The same by which it must part in the step from one that is nearer."""
_STRAIGHT = 0.99
"""Cosine of the turn of a velocity in a step, up to which no wall is met."""
_GOES_ON = 0.3
"""Share of the speed that is left after a step in which a body does not come to rest."""
_MOVES = 0.02
"""Share of the greatest speed from which a body moves."""
_KEPT, _ROUNDS = 0.8, 8
_LEAST_STEPS = 10


def fit_slowing(
    trajectories: Iterable[Trajectory], contact_distance: float
) -> dict[str, tuple[float, float]]:
    """Deceleration, m/s^2, and damper, 1/s, of each passive type that is seen to slide.

    Trimmed least squares of -dv/dt = a + c v, both at least 0, over steps in which it does not gain
    speed and parts from all bodies that are near.
    """
    rows: dict[str, list[np.ndarray]] = {}
    for each in trajectories:
        scene, velocity = each.scene, each.velocity
        offset = each.position[:, :, None] - each.position[:, None]
        apart = np.linalg.norm(offset, axis=-1) + np.diag(np.full(scene.node_count, np.inf))
        far = np.minimum(apart[:-1], apart[1:]) > _CLEAR * contact_distance
        with np.errstate(invalid="ignore"):  # of a body from itself
            parts = apart[1:] - apart[:-1] > _PARTS * contact_distance
        clear = np.all(far | parts, axis=-1)
        speed = np.linalg.norm(velocity, axis=-1)
        before, after = speed[:-1], speed[1:]
        product = before * after
        straight = np.sum(velocity[:-1] * velocity[1:], axis=-1) > _STRAIGHT * product
        goes_on = (
            (after > _GOES_ON * before)
            & (after < before)
            & (before > _MOVES * speed.max(initial=0.0))
        )
        if scene.gravity is not None and scene.has_weight:
            up = scene.gravity / np.linalg.norm(scene.gravity)
            goes_on &= np.abs(velocity[:-1] @ up) < 0.1 * before
        slides = clear & straight & goes_on & (product > 0.0) & ~scene.actuated
        slowing = (before - after) / scene.dt
        for node, name in enumerate(scene.node_type):
            found = np.stack([before[:, node], slowing[:, node]], axis=1)[slides[:, node]]
            rows.setdefault(name, []).append(found)
    fits = {name: np.concatenate(found) for name, found in rows.items()}
    return {name: _fit(*rows.T) for name, rows in fits.items() if len(rows) >= _LEAST_STEPS}


def _fit(speed: np.ndarray, slowing: np.ndarray) -> tuple[float, float]:
    """Of both together, or of one alone where the other would speed bodies up."""
    kept, best = np.ones(len(speed), bool), np.zeros(2)
    for _ in range(_ROUNDS):
        v, y = speed[kept], slowing[kept]
        both = np.linalg.lstsq(np.stack([np.ones_like(v), v], axis=1), y, rcond=None)[0]
        alone = [np.array([y.mean(), 0.0]), np.array([0.0, (v @ y) / (v @ v)])]
        tried = [np.maximum(each, 0.0) for each in (alone if (both < 0.0).any() else [both])]
        best = min(tried, key=lambda each: float(np.sum((y - each[0] - each[1] * v) ** 2)))
        off = np.abs(slowing - best[0] - best[1] * speed)
        kept = off <= np.quantile(off, _KEPT)
    return float(best[0]), float(best[1])
