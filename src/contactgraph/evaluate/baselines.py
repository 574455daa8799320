"""Predictions that need no learning: what any model must be better than."""

import numpy as np

from contactgraph.data import Scene, Trajectory, joined


def constant_velocity(run: Trajectory, steps: int) -> np.ndarray:
    """[S, H, N, D] m: positions under no forces, for ``H = steps`` from every start of a run."""
    starts = run.steps - steps + 1
    elapsed = run.scene.dt * np.arange(1, steps + 1)[:, None, None]
    return run.position[:starts, None] + elapsed * run.velocity[:starts, None]


def frozen_contact(run: Trajectory, steps: int) -> np.ndarray | None:
    """[S, H, N, D] m: positions with the true masses and the contacts of each window's first state.

    Nodes that are joined by contacts there, directly or through others, stay one group for the
    whole window. All its members accelerate alike, by the sum of the control on its actuated
    members over the sum of its masses, and start with their own velocities. Component d of the
    control is the force on degree of freedom d, as in the model.

    A step of n symplectic substeps moves a body under constant force by
    ``v dt + theta a dt^2`` with ``theta = (n+1)/2n``; n is ``substeps`` of the scene's metadata,
    and theta is 1/2, the exact motion, where it is not given.

    Where bodies have weight (`Scene.gravity`), that of a group's members which are not actuated
    pulls it down, as long as an actuated one carries it; a group that nothing actuated is in rests
    on something, which bears it and rubs on nothing: it keeps its velocity. What a carried body
    may still stand on is left out.

    A group with a body on a hinge turns about it instead: see `hinged_positions`.

    None where masses or contacts are unknown, or where there are hinges not in the plane.
    """
    scene = run.scene
    if run.contact is None or scene.mass is None or not np.all(scene.mass > 0):
        return None
    hinged = scene.anchor is not None and bool(np.any(np.isfinite(scene.anchor)))
    if hinged and scene.dimension != 2:
        return None
    starts = run.steps - steps + 1
    group = joined(run.contact[:starts])
    pushes = group @ scene.actuated / (group @ scene.mass)
    force = _windows(_force(run), steps)
    acceleration = pushes[:, None, :, None] * force[:, :, None, :]
    if scene.gravity is not None:
        hanging = (pushes > 0.0) * (group @ (scene.mass * ~scene.actuated)) / (group @ scene.mass)
        acceleration = acceleration + hanging[:, None, :, None] * scene.gravity
    dt = scene.dt
    gained = dt * np.cumsum(acceleration, axis=1)
    # What was gained in earlier steps moves the body for all of this one.
    before = gained - dt * acceleration
    moved = np.cumsum(dt * before + _theta(_substeps(run)) * dt**2 * acceleration, axis=1)
    straight = constant_velocity(run, steps) + moved
    if not hinged:
        return straight
    position, velocity = run.position[:starts], run.velocity[:starts]
    turned, turns = hinged_positions(scene, group, position, velocity, force, _substeps(run))
    return np.where(turns[:, None, :, None], turned, straight)


def _force(run: Trajectory) -> np.ndarray:
    """[T, D] N: components beyond the control's size are zero."""
    force = np.zeros((run.steps, run.scene.dimension))
    used = min(run.control_size, run.scene.dimension)
    force[:, :used] = run.control[:, :used]
    return force


def _windows(per_step: np.ndarray, steps: int) -> np.ndarray:
    """[T - H + 1, H, D], a view."""
    view = np.lib.stride_tricks.sliding_window_view(per_step, steps, axis=0)
    return np.moveaxis(view, -1, 1)


def _substeps(run: Trajectory) -> int | None:
    substeps = run.scene.metadata.get("substeps")
    if not isinstance(substeps, int | np.integer) or substeps < 1:
        return None
    return int(substeps)


def _theta(substeps: int | None) -> float:
    return 0.5 if substeps is None else (substeps + 1) / (2 * substeps)


_SUBSTEPS = 10
"""For the exact motion."""


def hinged_positions(
    scene: Scene,
    group: np.ndarray,
    position: np.ndarray,
    velocity: np.ndarray,
    force: np.ndarray,
    substeps: int | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Where groups with a hinge are, [S, H, N, 2] m, and which nodes are in one, [S, N] bool.

    ``group``: [S, N, N] 0 or 1, who moves with whom. ``position`` and ``velocity``: [S, N, 2] m
    and m/s, at the start. ``force``: [S, H, 2] N, on every actuated node. ``scene`` must have
    masses and anchors, in the plane. ``substeps``: the simulator's own a step, symplectic; None:
    the exact motion. Entries of nodes in no such group mean nothing.

    A group begins with its members' angular momentum about the hinge. One that hangs on hinges at
    two places cannot turn and stands still.
    """
    anchor, mass = scene.anchor, scene.mass
    if anchor is None or mass is None:
        raise ValueError("scene must have anchors and masses")
    hinged = np.isfinite(anchor).all(axis=1)
    holds = group * hinged
    turns = holds.any(axis=-1)
    pivot = np.where(hinged[:, None], anchor, 0.0)[np.argmax(holds, axis=-1)]
    elsewhere = np.any(anchor[None, None] != pivot[:, :, None], axis=-1)
    blocked = np.any((holds > 0) & elsewhere, axis=-1)

    arm = position - pivot
    square = np.sum(arm**2, axis=-1)
    inertia = _summed(group, mass * square * np.where(hinged, 4.0 / 3.0, 1.0))
    # Nothing turns about itself: a body in its own hinge has no arm to turn it by.
    can_turn = turns & ~blocked & (inertia > 0.0)
    inverse = np.where(can_turn, 1.0, 0.0) / np.where(inertia > 0.0, inertia, 1.0)
    # A bar's own velocity is that of its middle: its momentum is I / |r|^2 times the moment of it.
    spin = mass * np.where(hinged, 4.0 / 3.0, 1.0) * _cross(arm, velocity)
    speed = inverse * _summed(group, spin)
    angle = np.zeros_like(speed)

    count = _SUBSTEPS if substeps is None else substeps
    small = scene.dt / count
    # A simulator's substep moves by the new speed alone. Half of each, the torque in between, is
    # exact where the torque is constant.
    before = 0.5 * small if substeps is None else 0.0
    places = []
    for step in range(force.shape[1]):
        for _ in range(count):
            angle = angle + before * speed
            moment = scene.actuated * _cross(_turned(arm, angle), force[:, step, None])
            speed = speed + small * inverse * _summed(group, moment)
            angle = angle + (small - before) * speed
        places.append(pivot + _turned(arm, angle))
    return np.stack(places, axis=1), turns


def _summed(group: np.ndarray, value: np.ndarray) -> np.ndarray:
    """[S, N] sums of ``value`` [S, N] over each node's group."""
    return np.einsum("sij,sj->si", group, value)


def _cross(arm: np.ndarray, other: np.ndarray) -> np.ndarray:
    return arm[..., 0] * other[..., 1] - arm[..., 1] * other[..., 0]


def _turned(arm: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """``arm`` [S, N, 2] turned by ``angle`` [S, N] rad."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = arm[..., 0], arm[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
