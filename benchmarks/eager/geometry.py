"""Distances and relative motion along the edges; arrays have any leading axes."""

from dataclasses import dataclass

import torch
from torch import Tensor

CHORDS, REFINEMENTS = 8, 3
RESTING_SPEED = 0.01
SMALLEST = 1e-12


@dataclass
class Geometry:
    """Geometry of all edges, relative to the first node of each."""

    displacement: Tensor
    relative_velocity: Tensor
    distance: Tensor
    nearest: Tensor
    fraction_after_impact: Tensor


def geometry(
    position: Tensor, velocity: Tensor, pairs: Tensor, dt: float, touch: Tensor, push: Tensor | None
) -> Geometry:
    """``position``, ``velocity`` and ``push`` [..., N, D]; ``pairs`` [E, 2]; ``touch`` m."""

    def relative(motion: Tensor) -> Tensor:
        return motion[..., pairs[:, 1], :] - motion[..., pairs[:, 0], :]

    displacement, velocities = relative(position), relative(velocity)
    drifted = dt * velocities
    driven = torch.zeros_like(drifted) if push is None else relative(push)
    until, nearest = _closest(displacement, drifted, driven, 1 if push is None else CHORDS)
    meets = torch.zeros_like(until, dtype=torch.bool)
    for _ in range(1 if push is None else REFINEMENTS):
        until, meets = _touch(displacement, drifted + until[..., None] * driven, touch)
    square = ((drifted + driven) ** 2).sum(-1)
    impact = meets * square / (square + (RESTING_SPEED * dt) ** 2)
    return Geometry(displacement, velocities, _norm(displacement), nearest, (1.0 - until) * impact)


def _closest(
    displacement: Tensor, drifted: Tensor, driven: Tensor, chords: int
) -> tuple[Tensor, Tensor]:
    ends = torch.linspace(0.0, 1.0, chords + 1).reshape(-1, *[1] * displacement.dim())
    path = displacement + ends * (drifted + ends * driven)
    begin, way = path[:-1], path[1:] - path[:-1]
    square = (way**2).sum(-1).clamp(min=SMALLEST)
    along = (-(begin * way).sum(-1) / square).clamp(0.0, 1.0)
    nearest, chord = _norm(begin + along[..., None] * way).min(dim=0)
    part = along.gather(0, chord[None])[0]
    return (chord + part) / chords, nearest


def _touch(displacement: Tensor, way: Tensor, touch: Tensor) -> tuple[Tensor, Tensor]:
    square = (way**2).sum(-1).clamp(min=SMALLEST)
    closing = -(displacement * way).sum(-1)
    discriminant = closing**2 - square * ((displacement**2).sum(-1) - touch**2)
    meets = (discriminant > 0) & (closing > 0)
    root = torch.sqrt(torch.where(meets, discriminant, torch.ones_like(discriminant)))
    until = (torch.where(meets, closing - root, closing) / square).clamp(0.0, 1.0)
    return until, meets & (until < 1.0)


def _norm(vector: Tensor) -> Tensor:
    return torch.sqrt((vector**2).sum(-1) + SMALLEST)
