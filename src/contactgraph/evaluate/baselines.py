"""Baselines without learning: constant velocity, and an oracle with fixed contacts.

Groups of bodies on hinges turn about the hinge. A group with a hinged body is rigid and turns about
the anchor h; with the members' positions r_n = p_n - h and I_n = m_n |r_n|^2, or 4/3 of that for a
hinged bar (whose middle is at r_n), its angular acceleration is (sum of r_n x u over the actuated
members) / (sum of I_n).
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from contactgraph.data import Scene, Trajectory, generalized_coordinates, joined
from contactgraph.data.turns import turned_on

Predictor = Callable[[Trajectory, int], np.ndarray | None]
"""[S, H, N, D] m: positions ``H`` steps ahead from each of the S states of a trajectory that has
so many after it; with the columns of angles, rad, where those are predicted, too: one in the plane,
a rotation vector in space. None: not known for this trajectory."""


def standing_still(trajectory: Trajectory, steps: int) -> np.ndarray:
    """[S, H, N, D] m: the positions of every start, for ``H = steps`` steps."""
    starts = trajectory.steps - steps + 1
    return np.repeat(trajectory.position[:starts, None], steps, axis=1)


def constant_velocity(trajectory: Trajectory, steps: int) -> np.ndarray:
    """[S, H, N, D] m: positions without forces, ``H = steps`` ahead from every start."""
    starts = trajectory.steps - steps + 1
    elapsed = trajectory.scene.dt * np.arange(1, steps + 1)[:, None, None]
    return trajectory.position[:starts, None] + elapsed * trajectory.velocity[:starts, None]


def constant_rates(trajectory: Trajectory, steps: int) -> np.ndarray:
    """`constant_velocity` with the angles at constant angular velocity; 0 where it is unknown."""
    dimension, starts = trajectory.scene.dimension, trajectory.steps - steps + 1
    states = trajectory.position, trajectory.velocity
    turning = trajectory.orientation, trajectory.angular_velocity
    poses, rates = generalized_coordinates(1.0, *states, *turning)
    elapsed = trajectory.scene.dt * np.arange(1, steps + 1)[:, None, None]
    turned = elapsed * np.nan_to_num(rates[:starts, None, :, dimension:])
    angles = turned_on(poses[:starts, None, :, dimension:], turned)
    return np.concatenate([constant_velocity(trajectory, steps), angles], axis=-1)


def fixed_contact_oracle(trajectory: Trajectory, steps: int) -> np.ndarray | None:
    """[S, H, N, D] m: positions with the true masses and the contacts of each window's first state.

    Nodes that contacts connect there, directly or through others, stay one group for the whole
    window. All its members have one acceleration, the sum of the forces on them over the sum of
    their masses, and start with their own velocities. A group with a static member is not
    accelerated, and static bodies stay. The forces are components of the control: see `node_force`.

    A step of n symplectic substeps moves a body under constant force by
    ``v dt + theta a dt^2`` with ``theta = (n+1)/2n``; n is ``substeps`` of the scene's metadata,
    and theta is 1/2, the exact motion, where it is not given.

    Where bodies have weight (`Scene.gravity`), the weight of its members without actuation pulls a
    group down if it has an actuated member; a group without one rests on a frictionless support and
    keeps its velocity. Supports under a lifted body are neglected.

    A group with a body on a hinge turns about it instead: see `hinged_positions`.

    None where masses or contacts are unknown, where the control is not a force, or where there are
    hinges not in the plane.
    """
    scene = trajectory.scene
    static, hinged = scene.static, scene.hinged.any()
    applied = node_force(trajectory)
    if trajectory.contact is None or scene.mass is None or applied is None:
        return None
    if not np.all(scene.mass[~static] > 0):
        return None
    if hinged and scene.dimension != 2:
        return None
    starts = trajectory.steps - steps + 1
    group = joined(trajectory.contact[:starts])
    # A static body has no mass of its own: its groups are not accelerated.
    mass = group @ np.where(static, 1.0, scene.mass)
    inverse_mass = np.where(group @ static > 0.0, 0.0, 1.0 / mass)[:, None, :, None]
    force = sliding_windows(applied, steps)
    acceleration = inverse_mass * (group[:, None] @ force)
    if scene.has_weight:
        carried = (group @ scene.actuated > 0.0) * (group @ (scene.mass * ~scene.actuated))
        acceleration = acceleration + inverse_mass * carried[:, None, :, None] * scene.gravity
    dt = scene.dt
    gained = dt * np.cumsum(acceleration, axis=1)
    # Velocity gained in earlier steps moves the body for the whole of this one.
    before = gained - dt * acceleration
    count = _substeps(trajectory)
    theta = 0.5 if count is None else (count + 1) / (2 * count)
    moved = np.cumsum(dt * before + theta * dt**2 * acceleration, axis=1)
    straight = constant_velocity(trajectory, steps) + moved
    straight[:, :, static] = trajectory.position[:starts, None, static]
    if not hinged:
        return straight
    position, velocity = trajectory.position[:starts], trajectory.velocity[:starts]
    around, turns = hinged_positions(scene, group, position, velocity, force, count)
    return np.where(turns[:, None, :, None], around, straight)


def node_force(trajectory: Trajectory) -> np.ndarray | None:
    """[T, N, D] N: the force of the control on each node.

    Component d is the force on degree of freedom d of every actuated node, or where
    `Scene.control_of` is given, the d-th of the components that are forces on a node. Further
    components move nothing. None where something is actuated, and not by forces and switches alone.
    """
    scene, control = trajectory.scene, trajectory.control
    force = np.zeros((trajectory.steps, scene.node_count, scene.dimension))
    if not scene.actuated.any():
        return force
    kinds = scene.control_kind or ("force",) * trajectory.control_size
    if not set(kinds) <= {"force", "switch"}:
        return None
    is_force = np.array([kind == "force" for kind in kinds], dtype=bool)
    used = min(len(kinds), scene.dimension)
    if scene.control_of is None:
        force[:, scene.actuated, :used] = (control * is_force)[:, None, :used]
        return force
    for node, acts in enumerate(scene.control_of):
        own = np.flatnonzero(acts & is_force)[: scene.dimension]
        force[:, node, : len(own)] = control[:, own]
    return force


def sliding_windows(values: np.ndarray, length: int) -> np.ndarray:
    """[T - L + 1, L, ...], a view of ``values`` [T, ...]: L = ``length`` of them from each on."""
    view = np.lib.stride_tricks.sliding_window_view(values, length, axis=0)
    return np.moveaxis(view, -1, 1)


def _substeps(trajectory: Trajectory) -> int | None:
    substeps = trajectory.scene.metadata.get("substeps")
    if not isinstance(substeps, int | np.integer) or substeps < 1:
        return None
    return int(substeps)


_SUBSTEPS = 10
"""Substeps a step for the exact motion."""


def hinged_positions(
    scene: Scene,
    group: np.ndarray,
    position: np.ndarray,
    velocity: np.ndarray,
    force: np.ndarray,
    substeps: int | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions of groups with a hinge, [S, H, N, 2] m, and whether a node is in one, [S, N] bool.

    ``group``: [S, N, N] 0 or 1, whether two nodes move together. ``position`` and ``velocity``:
    [S, N, 2] m and m/s, at the start. ``force``: [S, H, N, 2] N, on each node. ``scene`` must have
    masses and anchors, in the plane. ``substeps``: the simulator's own a step, symplectic; None:
    the exact motion. Entries of nodes in no such group mean nothing.

    A group begins with its members' angular momentum about the hinge. A group on hinges at two
    positions cannot turn and stays at rest.
    """
    anchor, mass, hinged = scene.anchor, scene.mass, scene.hinged
    if mass is None:
        raise ValueError("scene must have masses")
    member = group * hinged
    turns = member.any(axis=-1)
    pivot = np.where(hinged[:, None], anchor, 0.0)[np.argmax(member, axis=-1)]
    elsewhere = np.any(anchor[None, None] != pivot[:, :, None], axis=-1)
    blocked = np.any((member > 0) & elsewhere, axis=-1)

    summed = partial(np.einsum, "sij,sj->si", group)  # over each node's group
    radius = position - pivot
    square = np.sum(radius**2, axis=-1)
    inertia = summed(mass * square * np.where(hinged, 4.0 / 3.0, 1.0))
    # A body at its own hinge has no radius to turn by.
    can_turn = turns & ~blocked & (inertia > 0.0)
    inverse = np.where(can_turn, 1.0, 0.0) / np.where(inertia > 0.0, inertia, 1.0)
    # A bar's velocity is that of its middle; its momentum is I / |r|^2 times that moment.
    spin = mass * np.where(hinged, 4.0 / 3.0, 1.0) * _cross(radius, velocity)
    speed = inverse * summed(spin)
    angle = np.zeros_like(speed)

    count = _SUBSTEPS if substeps is None else substeps
    small = scene.dt / count
    # A simulator's substep moves by the new speed alone. Half of the old and half of the new speed
    # is exact where the torque is constant.
    before = 0.5 * small if substeps is None else 0.0
    positions = []
    for step in range(force.shape[1]):
        for _ in range(count):
            angle = angle + before * speed
            moment = _cross(turned(radius, angle), force[:, step])
            speed = speed + small * inverse * summed(moment)
            angle = angle + (small - before) * speed
        positions.append(pivot + turned(radius, angle))
    return np.stack(positions, axis=1), turns


def _cross(radius: np.ndarray, other: np.ndarray) -> np.ndarray:
    return radius[..., 0] * other[..., 1] - radius[..., 1] * other[..., 0]


def turned(radius: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """``radius`` [..., 2] turned by ``angle`` [...] rad, in the plane."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = radius[..., 0], radius[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
