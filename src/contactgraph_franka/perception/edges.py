"""Tag edges in a picture, to a few hundredths of a pixel.

A detector's corners are a tenth of a pixel off, mostly outwards, and some a whole pixel; at 1 m
that is millimetres of distance. Under a symmetric blur, grey is halfway between white and black
exactly at the edge.
"""

from dataclasses import dataclass

import numpy as np

_SEARCH = 2.5  # px, largest search distance across an edge
_CELL_SHARE = 0.85  # Largest search distance, in cells of the tag; the next cell has another colour
CELLS = 8
"""Cells along a tag36h11 with its black border; a white one, a cell wide, must surround it."""
_LEAST_SEARCH = 0.9  # px; a cell narrower than that is no wider than the blur
_ALONG = np.linspace(0.07, 0.93, 24)
"""Sample positions along an edge, without the ends, which the next edge blurs."""
_ACROSS = np.linspace(-1.0, 1.0, 11)
"""Sample positions across, in search distances; positive is outwards."""
_LEAST_CONTRAST = 12.0  # grey levels
_OUTLIER = 0.5  # px from the median of an edge
_FINEST, _NARROW = 0.03, 0.25
"""Standard deviation of an edge with cells of at least 3 px, px, and of narrower ones times the
square of their width, px^3; measured on rendered pictures (benchmarks/tag_pose.py)."""


@dataclass(frozen=True, eq=False)
class Edges:
    """``E`` straight edges, as observed in a picture."""

    ends: np.ndarray
    """[E, 2, 2] px: the observed edge beside the two points of the search."""
    normal: np.ndarray
    """[E, 2]: the outward unit normal."""
    noise: np.ndarray
    """[E] px, standard deviation along the normal."""
    found: np.ndarray
    """[E] bool: whether the other fields are valid."""


def find_edges(image: np.ndarray, corners: np.ndarray) -> Edges:
    """The edges of black squares in ``image`` [H, W] uint8, four a square.

    ``corners`` [S, 4, 2] px are approximate, up to 2 px off, with pixel centres at integers. The
    edges join each corner to the next, square by square.
    """
    starts = corners.reshape(-1, 2)
    sides = np.roll(corners, -1, axis=1).reshape(-1, 2) - starts
    middles = np.repeat(corners.mean(axis=1), 4, axis=0)
    lengths = np.maximum(np.linalg.norm(sides, axis=1), 1e-9)
    normal = np.stack([sides[:, 1], -sides[:, 0]], axis=1) / lengths[:, None]
    inwards = np.einsum("ec,ec->e", middles - starts, normal)
    normal *= -np.sign(inwards)[:, None]
    cell = 2.0 * np.abs(inwards) / CELLS
    search = np.minimum(_SEARCH, _CELL_SHARE * cell)
    samples = (
        starts[:, None, None]
        + _ALONG[:, None, None] * sides[:, None, None]
        + (search[:, None] * _ACROSS)[:, None, :, None] * normal[:, None, None]
    )
    grey, inside = _interpolated(image, samples)
    black = np.median(grey[:, :, :2], axis=(1, 2))
    white = np.median(grey[:, :, -2:], axis=(1, 2))
    shift = _crossing(grey, (black + white) / 2.0) * search[:, None]
    at_ends, enough = _fit_lines(shift)
    contrast = white - black > _LEAST_CONTRAST
    return Edges(
        np.stack([starts, starts + sides], axis=1) + at_ends[:, :, None] * normal[:, None],
        normal,
        np.maximum(_FINEST, _NARROW / np.maximum(cell, 1e-3) ** 2),
        inside & contrast & enough & (search > _LEAST_SEARCH),
    )


def _crossing(grey: np.ndarray, level: np.ndarray) -> np.ndarray:
    """[E, A] in search distances: the innermost rise of ``grey`` [E, A, B] through ``level``.

    NaN if there is none.
    """
    above = grey > level[:, None, None]
    rises = above[..., 1:] & ~above[..., :-1]
    distance = np.abs(_ACROSS[1:] + _ACROSS[:-1])
    index = np.where(rises, distance, np.inf).argmin(axis=-1)[..., None]
    low = np.take_along_axis(grey, index, -1)[..., 0]
    high = np.take_along_axis(grey, index + 1, -1)[..., 0]
    part = (level[:, None] - low) / np.where(high > low, high - low, 1.0)
    crossing = _ACROSS[index[..., 0]] + part * (_ACROSS[1] - _ACROSS[0])
    return np.where(rises.any(axis=-1), crossing, np.nan)


def _fit_lines(shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lines through shifts [E, A] px: values at both ends [E, 2], and whether enough agree."""
    known = np.isfinite(shift)
    shift = np.where(known, shift, 0.0)
    median = np.median(shift, axis=1, keepdims=True)
    weight = (known & (np.abs(shift - median) < _OUTLIER)).astype(float)
    count = np.maximum(weight.sum(axis=1), 1.0)
    mean_position = (weight @ _ALONG) / count
    mean_shift = (weight * shift).sum(axis=1) / count
    apart = _ALONG - mean_position[:, None]
    spread = (weight * apart**2).sum(axis=1)
    slope = (weight * apart * shift).sum(axis=1) / np.maximum(spread, 1e-9)
    ends = mean_shift[:, None] + slope[:, None] * (np.array([0.0, 1.0]) - mean_position[:, None])
    return ends, count >= 0.6 * len(_ALONG)


def _interpolated(image: np.ndarray, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bilinear grey at ``samples`` [E, ..., 2] px; and [E] whether all of them are inside."""
    height, width = image.shape
    whole = np.floor(samples).astype(int)
    last = np.array([width - 2, height - 2])
    inside = ((whole >= 0) & (whole <= last)).all(axis=(1, 2, 3))
    column, row = np.moveaxis(np.clip(whole, 0, last), -1, 0)
    right, down = np.moveaxis(samples - whole, -1, 0)
    flat = image.reshape(-1)
    corner = row * width + column
    upper = flat[corner] * (1.0 - right) + flat[corner + 1] * right
    lower = flat[corner + width] * (1.0 - right) + flat[corner + width + 1] * right
    return upper * (1.0 - down) + lower * down, inside
