"""Where the edges of tags are in a picture, to a few hundredths of a pixel.

A detector's corners are a tenth of a pixel off, mostly outwards, and some a whole pixel: at a metre
that is millimetres of distance. Across an edge that a lens blurs evenly, grey is halfway from white
to black just where the edge is.
"""

from dataclasses import dataclass

import numpy as np

_REACH = 2.5
"""px: how far across an edge is looked, at most."""
_SHARE_OF_CELL = 0.85
"""How far at most, in cells of the tag: beyond the next cell is something else."""
_CELLS = 8
"""A tag's side, in cells."""
_LEAST_REACH = 0.9
"""px: below it, a cell is no wider than the blur."""
_ALONG = np.linspace(0.07, 0.93, 24)
"""Places along an edge; its ends are left out, where the next edge's blur is."""
_ACROSS = np.linspace(-1.0, 1.0, 11)
"""Places across, in reaches; positive is outwards."""
_LEAST_CONTRAST = 12.0
"""Grey levels, from black to white."""
_FARTHEST = 0.5
"""px: a place farther from the median of its edge is not on it."""
_FINEST = 0.03
"""px, standard deviation of an edge with cells 3 px wide or wider, and of one with narrower ones,
_NARROW over the square of the width: measured on rendered pictures (benchmarks/tag_pose.py)."""
_NARROW = 0.25
"""px^3"""


@dataclass(frozen=True, eq=False)
class Edges:
    """Straight edges as found in a picture. ``E`` of them were looked for."""

    ends: np.ndarray
    """[E, 2, 2] px: where the edge passes by the two points it was looked for between."""
    normal: np.ndarray
    """[E, 2]: the unit vector across, outwards."""
    noise: np.ndarray
    """[E] px, standard deviation across."""
    found: np.ndarray
    """[E] bool: whether there is an edge; else the rest means nothing."""


def find_edges(image: np.ndarray, corners: np.ndarray) -> Edges:
    """The edges of black squares in ``image`` [H, W] uint8, four a square.

    ``corners`` [S, 4, 2] px are rough ones, up to 2 px off, with pixel centres at whole numbers.
    The edges are those from each corner to the next, of one square after the other.
    """
    starts = corners.reshape(-1, 2)
    ways = np.roll(corners, -1, axis=1).reshape(-1, 2) - starts
    middles = np.repeat(corners.mean(axis=1), 4, axis=0)
    lengths = np.maximum(np.linalg.norm(ways, axis=1), 1e-9)
    normal = np.stack([ways[:, 1], -ways[:, 0]], axis=1) / lengths[:, None]
    inwards = np.einsum("ec,ec->e", middles - starts, normal)
    normal *= -np.sign(inwards)[:, None]
    cell = 2.0 * np.abs(inwards) / _CELLS
    reach = np.minimum(_REACH, _SHARE_OF_CELL * cell)
    places = (
        starts[:, None, None]
        + _ALONG[:, None, None] * ways[:, None, None]
        + (reach[:, None] * _ACROSS)[:, None, :, None] * normal[:, None, None]
    )
    grey, inside = _interpolated(image, places)
    black = np.median(grey[:, :, :2], axis=(1, 2))
    white = np.median(grey[:, :, -2:], axis=(1, 2))
    shift = _crossing(grey, (black + white) / 2.0) * reach[:, None]
    at_ends, enough = _lines(shift)
    contrast = white - black > _LEAST_CONTRAST
    return Edges(
        np.stack([starts, starts + ways], axis=1) + at_ends[:, :, None] * normal[:, None],
        normal,
        np.maximum(_FINEST, _NARROW / np.maximum(cell, 1e-3) ** 2),
        inside & contrast & enough & (reach > _LEAST_REACH),
    )


def _crossing(grey: np.ndarray, level: np.ndarray) -> np.ndarray:
    """[E, A] in reaches: where ``grey`` [E, A, B] rises through the edge's level; NaN: nowhere.

    Of several such places, the one nearest to the middle.
    """
    above = grey > level[:, None, None]
    rises = above[..., 1:] & ~above[..., :-1]
    between = np.abs(_ACROSS[1:] + _ACROSS[:-1])
    place = np.where(rises, between, np.inf).argmin(axis=-1)[..., None]
    low = np.take_along_axis(grey, place, -1)[..., 0]
    high = np.take_along_axis(grey, place + 1, -1)[..., 0]
    part = (level[:, None] - low) / np.where(high > low, high - low, 1.0)
    crossing = _ACROSS[place[..., 0]] + part * (_ACROSS[1] - _ACROSS[0])
    return np.where(rises.any(axis=-1), crossing, np.nan)


def _lines(shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Straight lines through shifts [E, A] px: at both ends [E, 2], and whether enough agree."""
    known = np.isfinite(shift)
    shift = np.where(known, shift, 0.0)
    median = np.median(np.where(known, shift, 0.0), axis=1, keepdims=True)
    weight = (known & (np.abs(shift - median) < _FARTHEST)).astype(float)
    count = np.maximum(weight.sum(axis=1), 1.0)
    mean_place = (weight @ _ALONG) / count
    mean_shift = (weight * shift).sum(axis=1) / count
    apart = _ALONG - mean_place[:, None]
    spread = (weight * apart**2).sum(axis=1)
    slope = (weight * apart * shift).sum(axis=1) / np.maximum(spread, 1e-9)
    ends = mean_shift[:, None] + slope[:, None] * (np.array([0.0, 1.0]) - mean_place[:, None])
    return ends, count >= 0.6 * len(_ALONG)


def _interpolated(image: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey at ``places`` [E, ..., 2] px, bilinear; and [E] whether all of them are inside."""
    height, width = image.shape
    whole = np.floor(places).astype(int)
    last = np.array([width - 2, height - 2])
    inside = ((whole >= 0) & (whole <= last)).all(axis=(1, 2, 3))
    column, row = np.moveaxis(np.clip(whole, 0, last), -1, 0)
    right, down = np.moveaxis(places - whole, -1, 0)
    flat = image.reshape(-1)
    corner = row * width + column
    upper = flat[corner] * (1.0 - right) + flat[corner + 1] * right
    lower = flat[corner + width] * (1.0 - right) + flat[corner + width + 1] * right
    return upper * (1.0 - down) + lower * down, inside
