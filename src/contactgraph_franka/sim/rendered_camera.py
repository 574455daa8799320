"""A camera that renders a MuJoCo scene with given intrinsics and noise."""

import copy
import math
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.envs.arm_model import mujoco, open_renderer
from contactgraph_franka.perception.camera import CameraFrame, Intrinsics, Window
from contactgraph_franka.sim.camera import CameraSettings, frame_ring, publish_frame
from contactgraph_franka.sim.session import Session
from contactgraph_franka.sim.shared_state import GroundTruth

_BODY_RADIUS = 0.075  # m, of a sphere about a block's centre that contains it
_STEP = 64  # px: widths of windows are multiples of it, which bounds the number of renderers
_GREY = np.array([0.299, 0.587, 0.114], np.float32)
_DEPTH_STEP = 0.001  # m: depth cameras measure whole millimetres
_NOISE_PICTURES = 3
"""Pictures of noise drawn beforehand; a frame's noise begins at a random pixel of it."""
_VISUAL, _COLLISION, _SHOWN, _HIDDEN = 2, 3, 0, 4  # Groups of geoms


class RenderedCamera:
    """Renders frames at ``pose`` [4, 4] in the world.

    The camera's frame is that of `Intrinsics`, without distortion. ``grey_noise`` is a standard
    deviation in grey levels, ``depth_noise`` one in m at 1 m that grows with the square of the
    distance as for stereo cameras; None: no depth. ``fineness`` is the supersampling, everywhere
    or only about the named ``bodies``; every second pixel is then rendered elsewhere, which takes a
    quarter of the time. The model is copied. Raises `InvalidInputError` if MuJoCo has no OpenGL to
    render with.
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
        """[4, 4]: camera to world."""
        self._frame = Window(0, 0, intrinsics.width, intrinsics.height)
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
        # Shadows take most of the time without a GPU; `fineness` replaces anti-aliasing.
        visual.quality.shadowsize = visual.quality.offsamples = 0
        visual.headlight.ambient[:] = visual.headlight.diffuse[:] = 0.4
        visual.headlight.specular[:] = 0.0
        self._model.light_castshadow[:] = False
        self._renderers: dict[tuple[int, int], Any] = {}
        self._renderer(intrinsics.height, intrinsics.width)

    def picture(self, qpos: np.ndarray, time: float) -> CameraFrame:
        """The frame exposed at ``time`` s in the state ``qpos`` of the scene."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        exact = self._coarse() if self._bodies else self._grey(self._frame, self._fineness)
        for body in self._bodies:
            part = window_around(self._data.xpos[body], self.pose, self.intrinsics)
            if part is not None:
                exact[part.rows, part.columns] = self._grey(part, self._fineness)
        begin = int(self._random.integers((_NOISE_PICTURES - 1) * self._size))
        exact += self._noise[begin : begin + self._size].reshape(exact.shape)
        grey = np.clip(np.rint(exact, out=exact), 0, 255, out=exact).astype(np.uint8)
        return CameraFrame(grey, self._depth(), time)

    def close(self) -> None:
        """Releases the renderers."""
        for renderer in self._renderers.values():
            renderer.close()

    def _renderer(self, height: int, width: int) -> Any:
        size = height, width
        if size not in self._renderers:
            purpose = "a rendered camera needs"
            self._renderers[size] = open_renderer(self._model, height, width, purpose)
        return self._renderers[size]

    def _aimed(self, part: Window, height: int, width: int) -> Any:
        """A renderer at the camera's pose, with the frustum of a part of the frame."""
        lens = self.intrinsics
        renderer = self._renderer(height, width)
        renderer.update_scene(self._data)
        for camera in renderer.scene.camera:
            camera.pos[:] = self.pose[:3, 3]
            camera.forward[:] = self.pose[:3, 2]
            camera.up[:] = -self.pose[:3, 1]
            near = camera.frustum_near
            # Pixel centres are integers, so that edges of pixels are half a pixel further out.
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
        # Summing rows first, as integers, is four times as fast as one sum.
        rows = fine.reshape(part.height, fineness, -1).sum(axis=1, dtype=np.uint16)
        pixels = rows.reshape(-1, 3 * fineness).astype(np.float32)
        weights = np.tile(_GREY / fineness**2, fineness)
        return (pixels @ weights).reshape(part.height, part.width)

    def _coarse(self) -> np.ndarray:
        """[H, W] float32 grey levels of the frame, of which every second pixel is rendered."""
        lens = self.intrinsics
        height, width = -(-lens.height // 2), -(-lens.width // 2)
        # An odd size is rendered with a pixel beyond the frame.
        coarse = self._aimed(Window(0, 0, 2 * width, 2 * height), height, width).render()
        grey = (coarse.reshape(-1, 3).astype(np.float32) @ _GREY).reshape(height, width)
        return grey.repeat(2, axis=0).repeat(2, axis=1)[: lens.height, : lens.width]

    def _depth(self) -> np.ndarray | None:
        if self._depth_noise is None:
            return None
        lens, each = self.intrinsics, 1 if self._bodies else self._fineness
        renderer = self._aimed(self._frame, each * lens.height, each * lens.width)
        renderer.enable_depth_rendering()
        fine = renderer.render()
        renderer.disable_depth_rendering()
        exact = fine[each // 2 :: each, each // 2 :: each]
        noise = self._depth_noise * self._random.standard_normal(exact.shape, np.float32)
        noisy = exact + noise * exact**2
        return (np.rint(noisy / _DEPTH_STEP) * _DEPTH_STEP).astype(np.float32)


def window_around(point: np.ndarray, pose: np.ndarray, lens: Intrinsics) -> Window | None:
    """A square about a body at ``point`` [3] m, shifted into the frame; None if out of view.

    ``pose`` [4, 4] is the camera's.
    """
    x, y, z = (point - pose[:3, 3]) @ pose[:3, :3]
    if z <= _BODY_RADIUS:
        return None
    half = max(lens.fx, lens.fy) * _BODY_RADIUS / (z - _BODY_RADIUS)
    column, row = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
    if not (-half < column < lens.width + half and -half < row < lens.height + half):
        return None
    side = min(_STEP * int(np.ceil(2.0 * half / _STEP)), lens.width, lens.height)
    left = int(np.clip(round(column - side / 2.0), 0, lens.width - side))
    top = int(np.clip(round(row - side / 2.0), 0, lens.height - side))
    return Window(left, top, side, side)


def render(connection: Connection, session: Session, settings: CameraSettings) -> None:
    """Renders frames until the other end of ``connection`` closes; sends None when it can."""
    model = mujoco.MjModel.from_xml_path(str(session.folder / "scene.xml"))
    # The hand must occlude blocks; its visual meshes take twice as long as its collision shapes.
    group = model.geom_group
    group[group == _VISUAL] = _HIDDEN
    group[group == _COLLISION] = _SHOWN
    camera = RenderedCamera(
        model,
        settings.pose,
        settings.intrinsics,
        grey_noise=settings.grey_noise,
        bodies=[f"block{index}" for index in range(session.blocks)],
        seed=settings.seed,
    )
    truth = GroundTruth(session.folder)
    frames = frame_ring(session.folder, settings.intrinsics)
    connection.send(None)
    rate, pace = settings.rate, session.pace
    # Frames are due at multiples of 1 / rate on the reader's clock.
    number = math.ceil(time.monotonic() / pace * rate)
    while not connection.poll():
        _sleep_until(number / rate * pace)
        now = truth.newest()
        frame = camera.picture(now["qpos"], float(now["stamp"]))
        _sleep_until((frame.time + settings.delay) * pace)
        publish_frame(frames, frame)
        number = max(number + 1, math.ceil(time.monotonic() / pace * rate))


def _sleep_until(moment: float) -> None:
    """``moment`` s on the wall clock."""
    time.sleep(max(0.0, moment - time.monotonic()))
