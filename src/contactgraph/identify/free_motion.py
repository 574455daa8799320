"""Least squares of the motion of bodies that nothing touches: stepping, actuation, and sliding."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import scipy

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory import Trajectory
from contactgraph.dynamics.actuation import ActuationFit
from contactgraph.identify.shapes import pinned_group, pinned_motion

_UNMOVED = 0.02
"""Change of another body's velocity, as a share of the own one's root mean square, up to which a
step is taken for free of contact."""
_LEAST_FREE = 0.02
"""Share of the steps that must be free in this sense."""
_FAR = 0.5
"""Quantile of those steps' distances to the nearest body from which a step is taken: another body
may be held in its place."""
_ALONE = 0.85
"""The same of all steps, where too few are free."""
_KEPT = 0.8
"""Share of those steps, the best explained ones, by which the next round fits."""
_ROUNDS = 12
_LEAST_FORGOTTEN = -0.98
"""Coefficient of the velocity that a body follows within a step; less has no implicit damper."""
_DRIVING_KINDS = {"force", "position", "displacement", "velocity"}
"""Kinds of control that move the body on which they act, by `Scene.control_kind`: a force, and
those that a servo in the body follows."""
_FORGETS = 0.25
"""A damper times dt, from which it is that of a servo, and no drag."""
_BETTER = 0.5
"""Residual of a servo as a share of a force's, or of one with a target in the world as a share of
that of one without, if it is one."""

_CLEAR = 1.1
"""Contact distances from the nearest body at which a body slides by itself."""
_PARTS = 0.02
"""The same by which it must part in the step from one that is nearer."""
_STRAIGHT = 0.99
"""Cosine of the turn of a velocity in a step, up to which no wall is met."""
_RESTS = 0.3
"""Share of the speed that is left at most after a step in which a body comes to rest."""
_EXACT = 0.01
"""Error, as a share of the median speed, from which a step counts less."""
_SHARES = (0.01, 0.1, 0.5, 1.0)
"""Of the median speed that the ground takes in a step, from which fits begin."""
_MOVES = 0.02
"""Share of the greatest speed from which a body moves."""
_LEVEL = 0.1
"""Share of the speed along gravity, up to which a body slides on a ground."""
_MOST_DAMPED = 10.0
"""Of a damper times dt: with a greater one a step hardly depends on it, and training that starts
there does not get away."""
_LEAST_STEPS = 10
_SLOWED = 0.1
"""Share of the steps in which a body moves by itself that must slow it."""


def driving_components(trajectories: Iterable[Trajectory]) -> np.ndarray:
    """[U] bool: the components of the control that move a body.

    Without `Scene.control_kind` those are the first D, and all where several nodes have their own.
    Raises `InvalidInputError` where commands precede them, or where one acts on no node.
    """
    every = tuple(trajectories)
    scene = every[0].scene
    if scene.control_kind is not None:
        drives = np.array([kind in _DRIVING_KINDS for kind in scene.control_kind], bool)
    elif scene.control_of is not None:
        drives = np.asarray(scene.control_of.any(axis=0))
    else:
        drives = np.arange(every[0].control_size) < scene.dimension
    for index, each in enumerate(every):
        acts = each.scene.control_of
        if acts is not None and np.any(drives & ~acts.any(axis=0)):
            raise InvalidInputError(
                f"trajectory {index}: component {int(np.argmax(drives & ~acts.any(axis=0)))} of "
                "the control, which drives, must act on a node (control_of)"
            )
    if not drives[: drives.sum()].all():
        raise InvalidInputError(
            "components of the control that drive bodies must come before commands, found "
            f"{[bool(each) for each in drives]}"
        )
    return drives


def driving_control(trajectory: Trajectory, node: int, drives: np.ndarray) -> np.ndarray:
    """[T, U']: the U' components of the control that drive bodies, see `driving_components`; 0
    where one does not act on this node."""
    of = trajectory.scene.control_of
    acts = drives if of is None else drives & of[node]
    return np.where(acts, trajectory.control, 0.0)[:, drives]


def fit_theta(trajectories: Iterable[Trajectory]) -> float:
    """Share of a step's change of velocity that displaces within it, of the `ThetaMethod`.

    It is 1 where velocities are backward differences of positions.
    """
    change, extra = [], []
    for each in trajectories:
        dt = each.scene.dt
        change.append(dt * (each.velocity[1:] - each.velocity[:-1]).ravel())
        extra.append((each.position[1:] - each.position[:-1] - dt * each.velocity[:-1]).ravel())
    (theta,), _ = _trimmed(np.concatenate(change)[:, None, None], np.concatenate(extra)[:, None])
    return float(np.clip(theta, 0.51, 0.99))


def fit_actuation(trajectories: Iterable[Trajectory], theta: float) -> dict[str, ActuationFit]:
    """Trimmed least squares over the steps of each actuated type, by name.

    A target in the world has a spring, a displacement or a velocity only a damper, a force neither.
    Without a `Scene.control_kind` there is a damper, or a spring, if that halves the
    residual: of exact data the sign of a rounding error would else decide. There is a damper, too,
    where it takes more of the velocity in a step than what a body moves through does. Raises
    `InvalidInputError` as `driving_components`.
    """
    trajectories = tuple(trajectories)
    drives = driving_components(trajectories)
    kinds = trajectories[0].scene.control_kind
    driving = None if kinds is None else _DRIVING_KINDS & set(kinds)
    types: dict[str, list[tuple[Trajectory, int]]] = {}
    for each in trajectories:
        for node in np.flatnonzero(each.scene.actuated):
            types.setdefault(each.scene.node_type[node], []).append((each, int(node)))
    dt, fits = trajectories[0].scene.dt, {}
    for name, bodies in types.items():
        steps = _free_steps(bodies, drives)
        if driving is not None:
            damped = driving != {"force"}
            fit = _fit(steps, theta, dt, absolute="position" in driving, damped=damped)
        else:
            fit = _fit(steps, theta, dt, absolute=False, damped=False)
            for absolute in (False, True):
                servo = _fit(steps, theta, dt, absolute=absolute, damped=True)
                forgets = dt * servo.damping > _FORGETS and not absolute
                factor = 1.0 / _BETTER if forgets else _BETTER
                fit = servo if servo.residual < factor * fit.residual else fit
        fits[name] = fit
    return fits


class _Steps(NamedTuple):
    """Steps of bodies of one type that nothing touches."""

    position: np.ndarray
    """[S, D] m, before the step."""
    velocity: np.ndarray
    """[S, D] m/s, before the step."""
    control: np.ndarray
    """[S, U] those components that drive bodies."""
    pinned: np.ndarray
    """[S, D, 2K]: `pinned_motion` of what pins join to the body."""
    change: np.ndarray
    """[S, D] m/s of the velocity."""


def _free_steps(bodies: list[tuple[Trajectory, int]], drives: np.ndarray) -> _Steps:
    scenes = [each.scene for each, _ in bodies if len(each.scene.pins)]
    names = sorted({name for each in scenes for name in each.node_type})
    parts = []
    for each, node in bodies:
        group = pinned_group(each.scene)[node]
        apart = ~group & (np.arange(len(group)) != node)
        offset = np.linalg.norm(each.position - each.position[:, node : node + 1], axis=-1)
        offset[:, ~apart] = np.inf
        changes = np.diff(each.velocity, axis=0)
        steps = _Steps(
            position=each.position[:-1, node],
            velocity=each.velocity[:-1, node],
            control=driving_control(each, node, drives),
            pinned=pinned_motion(each.velocity, group, each.scene.node_type, names),
            change=changes[:, node],
        )
        moved = np.linalg.norm(changes[:, apart], axis=-1).max(axis=1, initial=0.0)
        nearest = np.minimum(offset[:-1], offset[1:]).min(axis=1, initial=np.inf)
        parts.append((*steps, moved, nearest))
    *rows, moved, nearest = (np.concatenate(part) for part in zip(*parts, strict=True))
    every = _Steps._make(rows)
    free = moved <= _UNMOVED * np.sqrt(np.mean(np.sum(every.change**2, axis=-1)))
    quantile = _FAR
    if free.mean() < _LEAST_FREE:
        free, quantile = np.ones_like(free), _ALONE
    near = free & np.isfinite(nearest)
    free &= nearest >= (np.quantile(nearest[near], quantile) if near.any() else 0.0)
    return _Steps._make(each[free] for each in every)


def _fit(steps: _Steps, theta: float, dt: float, *, absolute: bool, damped: bool) -> ActuationFit:
    dimension, size = steps.change.shape[1], steps.control.shape[1]
    # Unknowns: G row by row, b, friction, then one coefficient each of x (where absolute) and v.
    known = np.zeros((len(steps.change), dimension, dimension * (size + 1) + 2 + absolute))
    for axis in range(dimension):
        known[:, axis, axis * size : (axis + 1) * size] = steps.control
        known[:, axis, dimension * size + axis] = float(damped)
    speed = np.linalg.norm(steps.velocity, axis=1, keepdims=True)
    direction = steps.velocity / np.maximum(speed, 1e-12)
    known[..., dimension * (size + 1)] = direction * (not damped)
    known[..., -1] = steps.velocity
    if absolute:
        known[..., -2] = steps.position
    known = np.concatenate([steps.pinned, known], axis=-1)
    found, residual = _trimmed(known, steps.change)
    found = found[steps.pinned.shape[-1] :]
    # Back from the implicit step: with n its inertia, found = -dt (c + theta dt k) / n of v.
    by_velocity = max(float(found[-1]), _LEAST_FORGOTTEN / theta) if damped else 0.0
    inertia = 1.0 / (1.0 + theta * by_velocity)
    stiffness = max(0.0, -float(found[-2]) * inertia / dt) if absolute else 0.0
    return ActuationFit(
        matrix=found[: dimension * size].reshape(dimension, size) * inertia / dt,
        bias=found[dimension * size : dimension * (size + 1)] * inertia / dt,
        stiffness=stiffness,
        damping=max(0.0, -by_velocity * inertia / dt - theta * dt * stiffness),
        residual=residual,
    )


def _trimmed(known: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, float]:
    """Coefficients [P] by least squares of ``known`` [S, D, P] times them against ``found`` [S, D],
    which in each round drop the steps that the last one explains worst; and the root mean square
    error of the others."""
    kept = np.ones(len(found), bool)
    coefficients, error = np.zeros(known.shape[-1]), np.zeros(len(found))
    for _ in range(_ROUNDS):
        flat = known[kept].reshape(-1, known.shape[-1])
        coefficients = np.linalg.lstsq(flat, found[kept].reshape(-1), rcond=None)[0]
        error = np.linalg.norm(found - known @ coefficients, axis=1)
        kept = error <= np.quantile(error, _KEPT)
    return coefficients, float(np.sqrt(np.mean(error[kept] ** 2)))


def fit_slowing(
    trajectories: Iterable[Trajectory],
    contact_distance: float,
    distances: Callable[[Trajectory], np.ndarray],
) -> dict[str, tuple[float, float]]:
    """Deceleration, m/s^2, and damper, 1/s, of each passive type that is seen to slide.

    Robust least squares of v' = w / (1 + dt c w / v) with w = max(v - dt a, 0), the implicit step
    of `Contacts`, with a and c at least 0, over steps in which it loses speed and parts from all
    bodies that are near: ``distances`` [T+1, N, N] m are those of a trajectory. A type is left out
    that keeps its speed in many such steps.
    """
    rows: dict[str, list[np.ndarray]] = {}
    seen: dict[str, int] = {}
    dt = 1.0
    for each in trajectories:
        scene, velocity, dt = each.scene, each.velocity, each.scene.dt
        apart = distances(each)
        far = np.minimum(apart[:-1], apart[1:]) > _CLEAR * contact_distance
        with np.errstate(invalid="ignore"):  # of a body from itself
            parts = apart[1:] - apart[:-1] > _PARTS * contact_distance
        speed = np.linalg.norm(velocity, axis=-1)
        before, after = speed[:-1], speed[1:]
        rests = after < _RESTS * before
        straight = np.sum(velocity[:-1] * velocity[1:], axis=-1) > _STRAIGHT * before * after
        alone = before > _MOVES * speed.max(initial=0.0)
        alone &= np.all(far | parts, axis=-1) & (straight | rests) & ~scene.actuated
        alone &= ~scene.hinged  # which slow down because they turn
        slides = alone & (after < before)
        if scene.has_weight:
            up = scene.gravity / np.linalg.norm(scene.gravity)
            slides &= np.abs(velocity[:-1] @ up) < _LEVEL * before
        for node, name in enumerate(scene.node_type):
            found = np.stack([before[:, node], after[:, node]], axis=1)[slides[:, node]]
            rows.setdefault(name, []).append(found)
            seen[name] = seen.get(name, 0) + int(alone[:, node].sum())
    fits = {name: np.concatenate(found) for name, found in rows.items()}
    return {
        name: _slowing(rows[:, 0], rows[:, 1], dt)
        for name, rows in fits.items()
        if len(rows) >= max(_LEAST_STEPS, _SLOWED * seen[name])
    }


def _slowing(before: np.ndarray, after: np.ndarray, dt: float) -> tuple[float, float]:
    unit = float(np.median(before))

    def residual(shares: np.ndarray) -> np.ndarray:
        left = np.maximum(before - shares[0] * unit, 0.0)
        return left / (1.0 + shares[1] * left / before) - after

    fits = [
        scipy.optimize.least_squares(
            residual, [share, 0.01], bounds=(0.0, np.inf), loss="soft_l1", f_scale=_EXACT * unit
        )
        for share in _SHARES
    ]
    constant, by_speed = min(fits, key=lambda each: each.cost).x
    return float(constant) * unit / dt, min(float(by_speed), _MOST_DAMPED) / dt
