"""Bounce, friction and masses from impacts that trajectories show, before any training."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import scipy

from contactgraph.data.trajectory import Trajectory
from contactgraph.dynamics.actuation import ActuationFit
from contactgraph.identify.free_motion import driving_components, driving_control
from contactgraph.model.presets import PLANE, Impacts

_KINKS = 0.05
"""Change of velocity, in units of the greatest speed, from which a body met something."""
_MEETS = 0.1
"""Speed along or across the normal in these units, from which an impact tells something."""
_STRAIGHT = 0.1
"""Of the way in a step: how far paths before and after an impact may miss each other."""
_MOSTLY = 0.9
"""Cosine of the angle between the change of velocity and the normal, at least."""
_LEAST_IMPACTS = 10
_ALONG, _LEAST_STEPS, _SPREAD = 0.02, 50, 0.2
"""Relative speed, in units of the greatest, up to which one body carries another; how many steps
must tell the ratio of masses; and how far the middle half of them may differ."""
_EXACT = 0.01
"""Error in units of the greatest speed, from which an impact counts less."""


def fit_impacts(
    trajectories: Iterable[Trajectory], actuation: Mapping[str, ActuationFit]
) -> dict[tuple[str, str], Impacts]:
    """By the names of two types in their order, or of a type and `PLANE`.

    Robust fits over impacts of bodies that no servo moves, and none hinged, with each other and
    with planes.
    Straight paths before and after tell time and normal; the relative velocity tells bounce and
    friction (up to 0.48), whatever the masses, and momentum tells the ratio of masses. Pairs of
    which fewer than ten impacts are seen are left out.
    """
    drives = driving_components(trajectories)
    struck: dict[tuple[str, str], list[np.ndarray]] = {}
    carried: dict[tuple[str, str], list[np.ndarray]] = {}
    for each in trajectories:
        pushed = _pushed(each, actuation, drives)
        for pair, row in _impacts(each, pushed):
            struck.setdefault(pair, []).append(row)
        for pair, rows in _carried(each, pushed):
            carried.setdefault(pair, []).append(rows)
    ratios = {pair: _mass_ratio(np.concatenate(found)) for pair, found in carried.items()}
    laws = {pair: Impacts(0.0, None, ratio) for pair, ratio in ratios.items() if ratio}
    for pair, found in struck.items():
        if len(found) >= _LEAST_IMPACTS:
            laws[pair] = _fitted(np.array(found))
    return laws


def _pushed(
    each: Trajectory, actuation: Mapping[str, ActuationFit], drives: np.ndarray
) -> np.ndarray:
    """[T, N, D] m/s: change of velocity by forces on actuated bodies; NaN of what servos move."""
    scene = each.scene
    pushed = np.zeros((len(each.control), scene.node_count, scene.dimension))
    for node in np.flatnonzero(scene.actuated):
        fit = actuation.get(scene.node_type[node])
        pushed[:, node] = np.nan
        if fit is not None and not (fit.stiffness or fit.damping):
            control = driving_control(each, int(node), drives)
            pushed[:, node] = scene.dt * (control @ fit.matrix.T + fit.bias)
    return pushed


def _carried(each: Trajectory, pushed: np.ndarray) -> Iterator[tuple[tuple[str, str], np.ndarray]]:
    """Of every hand and body the types, in their order; and [S, 2] of the steps in which both move
    together the ratio of the masses, by the momentum that the one gives and the other gets, and
    the size of what the hand gives, m/s."""
    scene, kind = each.scene, each.scene.node_type
    unit = np.abs(each.velocity).max(initial=0.0)
    change = np.diff(each.velocity, axis=0)
    for hand in np.flatnonzero(scene.actuated & np.isfinite(pushed).all(axis=(0, 2))):
        for body in np.flatnonzero(~scene.actuated & ~scene.hinged):
            apart = np.linalg.norm(each.velocity[:, hand] - each.velocity[:, body], axis=-1)
            along = np.maximum(apart[1:], apart[:-1]) < _ALONG * unit
            moves = np.linalg.norm(each.velocity[1:, body], axis=-1) > _MEETS * unit
            gives = (change - pushed)[:, hand]
            gets = change[:, body] - scene.dt * scene.gravity
            ratio = -np.sum(gives * gets, axis=-1)
            ratio = ratio / np.maximum(np.sum(gives**2, axis=-1), 1e-30)
            first, second = sorted((hand, body), key=lambda node: kind[node])
            if first != hand:
                ratio = 1.0 / np.where(ratio == 0.0, np.nan, ratio)
            rows = np.stack([ratio, np.linalg.norm(gives, axis=-1)], axis=1)
            yield (kind[first], kind[second]), rows[along & moves]


def _mass_ratio(rows: np.ndarray) -> float | None:
    """The median of the ratios of `_carried`, of the steps in which much is given; None where too
    few steps tell it, or they do not agree."""
    ratio, size = rows.T
    ratio = ratio[size >= np.median(size)] if len(size) else size
    if len(ratio) < _LEAST_STEPS:
        return None
    low, middle, high = np.quantile(ratio, [0.25, 0.5, 0.75])
    return float(middle) if high - low < _SPREAD * middle else None


def _impacts(each: Trajectory, pushed: np.ndarray) -> Iterator[tuple[tuple[str, str], np.ndarray]]:
    """Of every impact the types; and in units of the greatest speed the approach, the parting, the
    speeds across the normal before and after; and the ratio of masses, NaN for none."""
    scene, kind = each.scene, each.scene.node_type
    unit = float(np.linalg.norm(each.velocity, axis=-1).max(initial=0.0)) or 1.0
    # As if forces acted in the middle of a step, half before the impact and half after it.
    before = (each.velocity[:-1] + 0.5 * pushed) / unit
    after = (each.velocity[1:] - 0.5 * pushed) / unit
    meets = ~(np.linalg.norm(after - before, axis=-1) <= _KINKS)
    fixed, normals = np.flatnonzero(scene.static), scene.planes[:, :-1]
    for step in np.flatnonzero(meets.any(axis=1)):
        x, v = each.position[step : step + 2], np.stack([before[step], after[step]])
        struck = np.flatnonzero(meets[step])
        if len(struck) > 2 or scene.hinged[struck].any() or np.isnan(v[0, struck]).any():
            continue
        one, found = struck[0], []
        for other in struck[1:] if len(struck) == 2 else fixed:
            first, second = sorted((one, other), key=lambda node: kind[node])
            relative = v[:, second] - v[:, first]
            normal = _normal(x[:, second] - x[:, first], relative, scene.dt * unit)
            change = np.diff(v[:, [first, second]] @ normal, axis=0)[0]
            ratio = -change[1] / change[0] if len(struck) == 2 and change[0] else np.nan
            found.append((kind[first], kind[second], _along(relative, normal, ratio)))
        if len(struck) == 1:
            found += [(kind[one], PLANE, _along(v[:, one], n, np.nan)) for n in normals]
        likely = [each for each in found if each[2][0] > _MEETS and each[2][1] > 0.0]
        if len(likely) == 1:
            yield likely[0][:2], likely[0][2]


def _normal(displacement: np.ndarray, velocity: np.ndarray, dt: float) -> np.ndarray:
    """[D] from displacements and relative velocities before and after: where straight paths meet;
    zeros where they do not meet within the step."""
    (begin, end), (before, after) = displacement, velocity
    kink = before - after
    time = (end - begin - dt * after) @ kink / max(float(kink @ kink), 1e-12)
    place = begin + time * before
    off = np.linalg.norm(place + (dt - time) * after - end)
    if not (0.0 <= time <= dt and off < _STRAIGHT * dt):
        return np.zeros_like(begin)
    return np.asarray(place / max(float(np.linalg.norm(place)), 1e-12))


def _along(velocity: np.ndarray, normal: np.ndarray, mass_ratio: float) -> np.ndarray:
    """[5] a row of `_impacts`; zeros where the change is not mostly along the normal."""
    before, after = velocity
    change = after - before
    if change @ normal < _MOSTLY * np.linalg.norm(change):
        return np.zeros(5)
    across = before - before @ normal * normal
    size = max(float(np.linalg.norm(across)), 1e-12)
    return np.array([-before @ normal, after @ normal, size, after @ across / size, mass_ratio])


def _fitted(rows: np.ndarray) -> Impacts:
    approach, parting, before, after, ratio = rows.T
    slides = (before > _MEETS) & (after > _MEETS)
    friction = None
    if slides.sum() >= _LEAST_IMPACTS:
        friction = _slope((approach + parting)[slides], (before - after)[slides])
    ratio = ratio[ratio > 0.0]
    return Impacts(
        bounce=min(_slope(approach, parting), 1.0),
        friction=friction,
        mass_ratio=float(np.median(ratio)) if len(ratio) >= _LEAST_IMPACTS else None,
    )


def _slope(x: np.ndarray, y: np.ndarray) -> float:
    """At least 0, of a robust line; the ground, which slows bodies too, gives its offset."""
    fit = scipy.optimize.least_squares(
        lambda line: line[0] * x + line[1] - y, [0.5, 0.0], loss="soft_l1", f_scale=_EXACT
    )
    return max(float(fit.x[0]), 0.0)
