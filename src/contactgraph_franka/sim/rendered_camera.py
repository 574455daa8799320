"""Parts of a frame."""

import copy
import math
import os
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.envs.arm_model import mujoco
from contactgraph_franka.loop.realtime import set_nice
from contactgraph_franka.perception.camera import CameraFrame, Intrinsics
from contactgraph_franka.sim.camera import FrameWriter
from contactgraph_franka.sim.session import read_session
from contactgraph_franka.sim.shared_state import GroundTruth, read_places

_HALF_BODY = 0.075
"""m: all of a block is within this distance of its centre, seen from wherever."""
_STEP = 64
"""px: widths are multiples of it, so that few different ones come up."""


@dataclass(frozen=True)
class Window:
    """Columns from ``left`` on and rows from ``top`` on, px."""

    left: int
    top: int
    width: int
    height: int

    @property
    def rows(self) -> slice:
        """Of the frame."""
        return slice(self.top, self.top + self.height)

    @property
    def columns(self) -> slice:
        """Of the frame."""
        return slice(self.left, self.left + self.width)


def whole(lens: Intrinsics) -> Window:
    """All of it."""
    return Window(0, 0, lens.width, lens.height)


def window_around(point: np.ndarray, pose: np.ndarray, lens: Intrinsics) -> Window | None:
    """A square about a body at ``point`` [3] m, moved into the frame; None where it is not in view.

    ``pose`` [4, 4] is the camera's.
    """
    x, y, z = (point - pose[:3, 3]) @ pose[:3, :3]
    if z <= _HALF_BODY:
        return None
    half = max(lens.fx, lens.fy) * _HALF_BODY / (z - _HALF_BODY)
    column, row = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
    if not (-half < column < lens.width + half and -half < row < lens.height + half):
        return None
    side = min(_STEP * int(np.ceil(2.0 * half / _STEP)), lens.width, lens.height)
    left = int(np.clip(round(column - side / 2.0), 0, lens.width - side))
    top = int(np.clip(round(row - side / 2.0), 0, lens.height - side))
    return Window(left, top, side, side)


_GREY = np.array([0.299, 0.587, 0.114], np.float32)
_DEPTH_STEP = 0.001
"""m: depth cameras tell whole millimetres."""
_NOISE_PICTURES = 3
"""As much noise is drawn beforehand; a frame's is a part of it, from a random pixel on."""


class RenderedCamera:
    """Renders what a camera would see at ``pose`` [4, 4] in the world, as a `CameraFrame`.

    The camera's frame is that of `Intrinsics`: x right, y down, z forward. ``intrinsics`` are met
    exactly; they must have no distortion. ``grey_noise`` is a standard deviation in grey levels,
    ``depth_noise`` one in m at 1 m, growing with the square of the distance as it does where depth
    comes from two views; None: no depth. Edges are smoothed by drawing ``fineness`` times as many
    pixels each way: everywhere, or, where ``bodies`` are named, only about these; elsewhere then
    every second pixel alone is drawn, and all of it takes a quarter of the time. The model is
    copied, so that whoever simulates it is not disturbed. Raises
    `InvalidInputError` where MuJoCo has no OpenGL to draw with.
    """

    def __init__(
        self,
        model: Any,
        pose: np.ndarray,
        intrinsics: Intrinsics,
        *,
        grey_noise: float = 2.0,
        depth_noise: float | None = None,
        fineness: int = 2,
        bodies: Sequence[str] = (),
        seed: int = 0,
    ) -> None:
        if intrinsics.distortion is not None:
            raise InvalidInputError(
                "a rendered camera has no distortion: intrinsics must have none"
            )
        self.intrinsics = intrinsics
        self.pose = np.array(pose, dtype=np.float64)
        """[4, 4]: where it stands, in the world's frame."""
        self._depth_noise = depth_noise
        self._fineness = fineness
        self._random = np.random.default_rng(seed)
        self._model = copy.deepcopy(model)
        self._data = mujoco.MjData(self._model)
        self._bodies = [self._model.body(name).id for name in bodies]
        self._size = intrinsics.height * intrinsics.width
        noise = self._random.standard_normal(_NOISE_PICTURES * self._size, np.float32)
        self._noise = grey_noise * noise
        visual = self._model.vis
        visual.global_.offwidth = fineness * intrinsics.width
        visual.global_.offheight = fineness * intrinsics.height
        # Shadows take most of the time where the processor draws; `fineness` smooths instead.
        visual.quality.shadowsize = visual.quality.offsamples = 0
        visual.headlight.ambient[:] = visual.headlight.diffuse[:] = 0.4
        visual.headlight.specular[:] = 0.0
        self._model.light_castshadow[:] = False
        self._renderers: dict[tuple[int, int], Any] = {}
        self._renderer(intrinsics.height, intrinsics.width)

    def picture(self, places: np.ndarray, time: float) -> CameraFrame:
        """The frame that is exposed at ``time`` s while the scene's ``qpos`` is ``places``."""
        self._data.qpos[:] = places
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        lens = self.intrinsics
        exact = self._coarse() if self._bodies else self._grey(whole(lens), self._fineness)
        for body in self._bodies:
            part = window_around(self._data.xpos[body], self.pose, lens)
            if part is not None:
                exact[part.rows, part.columns] = self._grey(part, self._fineness)
        begin = int(self._random.integers((_NOISE_PICTURES - 1) * self._size))
        exact += self._noise[begin : begin + self._size].reshape(exact.shape)
        grey = np.clip(np.rint(exact, out=exact), 0, 255, out=exact).astype(np.uint8)
        return CameraFrame(grey, self._depth(), time)

    def close(self) -> None:
        """Gives OpenGL back what it needs."""
        for renderer in self._renderers.values():
            renderer.close()

    def _renderer(self, height: int, width: int) -> Any:
        found = self._renderers.get((height, width))
        if found is not None:
            return found
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # GLFW warns where it fails
                made = mujoco.Renderer(self._model, height, width)
        except Exception as error:
            raise InvalidInputError(
                "a rendered camera needs OpenGL without a screen: set MUJOCO_GL=egl before Python "
                "starts (Debian: apt install libegl1 libegl-mesa0 libgl1-mesa-dri)"
            ) from error
        return self._renderers.setdefault((height, width), made)

    def _aimed(self, part: Window, height: int, width: int) -> Any:
        """A renderer whose camera is where `pose` says, with the frustum of a part of the frame."""
        lens = self.intrinsics
        renderer = self._renderer(height, width)
        renderer.update_scene(self._data)
        for camera in renderer.scene.camera:
            camera.pos[:] = self.pose[:3, 3]
            camera.forward[:] = self.pose[:3, 2]
            camera.up[:] = -self.pose[:3, 1]
            near = camera.frustum_near
            # Pixel centres are whole numbers: the picture's edges are half a pixel further out.
            left = near * (part.left - 0.5 - lens.cx) / lens.fx
            right = near * (part.left + part.width - 0.5 - lens.cx) / lens.fx
            camera.frustum_center = (left + right) / 2.0
            camera.frustum_width = (right - left) / 2.0
            camera.frustum_top = near * (lens.cy + 0.5 - part.top) / lens.fy
            camera.frustum_bottom = near * (lens.cy + 0.5 - part.top - part.height) / lens.fy
        return renderer

    def _grey(self, part: Window, fineness: int) -> np.ndarray:
        """[H, W] float32 grey levels of a part of the frame."""
        fine = self._aimed(part, fineness * part.height, fineness * part.width).render()
        # Rows first and in whole numbers: four times as fast as all at once.
        rows = fine.reshape(part.height, fineness, -1).sum(axis=1, dtype=np.uint16)
        pixels = rows.reshape(-1, 3 * fineness).astype(np.float32)
        weights = np.tile(_GREY / fineness**2, fineness)
        return (pixels @ weights).reshape(part.height, part.width)

    def _coarse(self) -> np.ndarray:
        """[H, W] float32 grey levels of all of the frame, of which every second pixel is drawn."""
        lens = self.intrinsics
        height, width = -(-lens.height // 2), -(-lens.width // 2)
        # Of an odd number the last one stands for a pixel beyond the frame.
        drawn = self._aimed(Window(0, 0, 2 * width, 2 * height), height, width).render()
        grey = (drawn.reshape(-1, 3).astype(np.float32) @ _GREY).reshape(height, width)
        return grey.repeat(2, axis=0).repeat(2, axis=1)[: lens.height, : lens.width]

    def _depth(self) -> np.ndarray | None:
        if self._depth_noise is None:
            return None
        lens, each = self.intrinsics, 1 if self._bodies else self._fineness
        renderer = self._aimed(whole(lens), each * lens.height, each * lens.width)
        renderer.enable_depth_rendering()
        fine = renderer.render()
        renderer.disable_depth_rendering()
        exact = fine[each // 2 :: each, each // 2 :: each]
        noise = self._depth_noise * self._random.standard_normal(exact.shape, np.float32)
        noisy = exact + noise * exact**2
        return (np.rint(noisy / _DEPTH_STEP) * _DEPTH_STEP).astype(np.float32)


_BEHIND = 5
"""How much this process yields to those that must be on time."""
_LOOKS, _HULLS, _SHOWN, _HIDDEN = 2, 3, 0, 4
"""Groups of shapes: those for looks, and the coarser ones that collide."""


def main() -> None:
    """Takes pictures until the owner ends."""
    folder = Path(sys.argv[1])
    session = read_session(folder)
    settings = session.camera
    if settings is None:
        raise InvalidInputError("this rehearsal has no camera")
    set_nice(_BEHIND)
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    # The hand must hide what it hides; drawn with its maker's surfaces it takes twice as long.
    group = model.geom_group
    group[group == _LOOKS] = _HIDDEN
    group[group == _HULLS] = _SHOWN
    camera = RenderedCamera(
        model,
        settings.pose,
        settings.intrinsics,
        grey_noise=settings.grey_noise,
        depth_noise=settings.depth_noise,
        bodies=[f"block{index}" for index in range(session.blocks)],
        seed=settings.seed,
    )
    truth = GroundTruth(folder, session.blocks, read_places(folder))
    frames = FrameWriter(folder, settings.intrinsics, settings.depth_noise is not None)
    _film(camera, truth, frames, session.pace, settings.rate, settings.delay)


def _film(
    camera: RenderedCamera,
    truth: GroundTruth,
    frames: FrameWriter,
    pace: float,
    rate: float,
    delay: float,
) -> None:
    """Takes ``rate`` frames a second of the reader's clock; each can be had ``delay`` s later."""
    owner = os.getppid()
    number = math.ceil(time.monotonic() / pace * rate)
    while os.getppid() == owner:
        _sleep_until(number / rate * pace)
        now = truth.newest()
        picture = camera.picture(now["places"], float(now["stamp"]))
        _sleep_until((picture.time + delay) * pace)
        frames.publish(picture)
        following = max(number + 1, math.ceil(time.monotonic() / pace * rate))
        frames.miss(following - number - 1)
        number = following


def _sleep_until(moment: float) -> None:
    """``moment`` s on the wall's clock."""
    time.sleep(max(0.0, moment - time.monotonic()))


if __name__ == "__main__":
    main()
