"""The part of a frame that a block is in."""

import numpy as np

from contactgraph_franka.sim.camera import CameraSettings
from contactgraph_franka.sim.rendered_camera import window_around

SETTINGS = CameraSettings()
CORNERS = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)


def test_all_of_a_block_is_in_its_window() -> None:
    lens, pose = SETTINGS.intrinsics, SETTINGS.pose
    rng = np.random.default_rng(0)
    for point in rng.uniform((0.3, -0.35, 0.05), (0.7, 0.35, 0.35), (200, 3)):
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        corners = (point + CORNERS * [0.02, 0.02, 0.05] @ turn - pose[:3, 3]) @ pose[:3, :3]
        column = lens.fx * corners[:, 0] / corners[:, 2] + lens.cx
        row = lens.fy * corners[:, 1] / corners[:, 2] + lens.cy
        part = window_around(point, pose, lens)
        assert part is not None and part.width == part.height and part.width <= 512
        inside = (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
        assert inside.all()
        assert part.left <= column.min() and column.max() < part.left + part.width
        assert part.top <= row.min() and row.max() < part.top + part.height


def test_a_window_stays_within_the_frame_and_there_is_none_out_of_view() -> None:
    lens, pose = SETTINGS.intrinsics, SETTINGS.pose
    for across in np.linspace(-0.9, 0.9, 37):
        part = window_around(np.array([0.5, across, 0.05]), pose, lens)
        if part is not None:
            assert part.left >= 0 and part.left + part.width <= lens.width
    assert window_around(np.array([0.5, 3.0, 0.05]), pose, lens) is None
    # Behind the camera.
    assert window_around(np.array([2.0, 0.0, 0.8]), pose, lens) is None
