"""Predictions that need no learning: what any model must be better than."""

import numpy as np

from contactgraph.data import Trajectory, joined
from contactgraph.evaluate.hinged_floor import hinged_positions


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
