r"""Frozen contact where bodies hang on hinges: what is held together turns about its hinge.

A group with a hinged body is rigid and turns about the anchor :math:`h`, with members' places
:math:`r_n = p_n - h`:

.. math:: \dot\omega = \frac{\sum_{n\,\text{actuated}} r_n \times u}{\sum_n I_n}, \qquad
    I_n = \tfrac13 m_n (2 |r_n|)^2 \text{ (hinged bar, its middle at } r_n), \quad
    I_n = m_n |r_n|^2 \text{ (any other)}.
"""

import numpy as np

from contactgraph.data import Scene

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
