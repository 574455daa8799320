"""Frontal pictures of tags without a renderer, exact to the pixel."""

import numpy as np
import pytest

from contactgraph_franka.perception import CameraCalibration, Intrinsics, single_tag
from contactgraph_franka.perception.camera import pose
from contactgraph_franka.perception.edges import CELLS

pytest.importorskip("pyapriltags", reason="the extra robot is not installed")
from contactgraph_franka.perception.tags import black_cells

LENS = Intrinsics(300.0, 300.0, 159.5, 119.5, 320, 240)
SIZE = 0.08
"""m"""
CAMERA = pose(
    np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([1.0, 0, 0])
)
"""In the base: looks back along its x axis, from 1 m."""
MADE = "2026-01-31T12:00:00+00:00"


def drawn(tags, cell=6, shape=(240, 320)):
    """[H, W] uint8 with each of ``tags`` (id, column, row of its upper left pixel)."""
    image = np.full(shape, 120, np.uint8)
    for tag, column, row in tags:
        side = cell * (CELLS + 2)
        ink = np.pad(black_cells(tag), 1).repeat(cell, 0).repeat(cell, 1)
        image[row : row + side, column : column + side] = np.where(ink, 20, 230)
    return image


def drawn_corners(column, row, cell=6):
    """[4, 2] px of the black square, as detectors order them, of a tag drawn there."""
    low = np.array([column, row]) + cell - 0.5
    high = low + cell * CELLS
    return np.array([[low[0], high[1]], high, [high[0], low[1]], low])


def calibration(tag=3):
    """Of the camera above, and one tag on an object called block."""
    return CameraCalibration(LENS, CAMERA, {"block": single_tag(tag, SIZE)}, MADE)
