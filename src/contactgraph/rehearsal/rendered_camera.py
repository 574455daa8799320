"""A camera over a MuJoCo scene: frames of a known ``qpos``, with known intrinsics, and noise."""

import copy
import warnings
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.robot.perception.camera import CameraFrame, Intrinsics
from contactgraph.tasks.mujoco.engine import mujoco

_GREY = np.array([0.299, 0.587, 0.114], np.float32)
_DEPTH_STEP = 0.001
"""m: depth cameras tell whole millimetres."""


class RenderedCamera:
    """Renders what a camera would see at ``pose`` [4, 4] in the world, as a `CameraFrame`.

    The camera's frame is that of `Intrinsics`: x right, y down, z forward. ``intrinsics`` are met
    exactly; they must have no distortion. ``grey_noise`` is a standard deviation in grey levels,
    ``depth_noise`` one in m at 1 m, growing with the square of the distance as it does where depth
    comes from two views; None: no depth. Edges are smoothed by drawing ``fineness`` times as many
    pixels each way. The model is copied, so that whoever simulates it is not disturbed. Raises
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
        seed: int = 0,
    ) -> None:
        if intrinsics.distortion is not None:
            raise InvalidInputError(
                "a rendered camera has no distortion: intrinsics must have none"
            )
        self.intrinsics = intrinsics
        self.pose = np.array(pose, dtype=np.float64)
        """[4, 4]: where it stands, in the world's frame."""
        self._grey_noise, self._depth_noise = grey_noise, depth_noise
        self._fineness = fineness
        self._random = np.random.default_rng(seed)
        self._model = copy.deepcopy(model)
        self._data = mujoco.MjData(self._model)
        width, height = fineness * intrinsics.width, fineness * intrinsics.height
        visual = self._model.vis
        visual.global_.offwidth, visual.global_.offheight = width, height
        # Shadows take most of the time where the processor draws; `fineness` smooths instead.
        visual.quality.shadowsize = visual.quality.offsamples = 0
        visual.headlight.ambient[:] = visual.headlight.diffuse[:] = 0.4
        visual.headlight.specular[:] = 0.0
        self._model.light_castshadow[:] = False
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # GLFW warns where it fails
                self._renderer = mujoco.Renderer(self._model, height, width)
        except Exception as error:
            raise InvalidInputError(
                "a rendered camera needs OpenGL without a screen: set MUJOCO_GL=egl before Python "
                "starts (Debian: apt install libegl1 libegl-mesa0 libgl1-mesa-dri)"
            ) from error

    def picture(self, places: np.ndarray, time: float) -> CameraFrame:
        """The frame that is exposed at ``time`` s while the scene's ``qpos`` is ``places``."""
        self._data.qpos[:] = places
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data)
        self._aim()
        exact = self._grey(self._renderer.render())
        noisy = exact + self._grey_noise * self._random.standard_normal(exact.shape, np.float32)
        grey = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        return CameraFrame(grey, self._depth(), time)

    def close(self) -> None:
        """Gives OpenGL back what it needs."""
        self._renderer.close()

    def _aim(self) -> None:
        """Puts the scene's camera where `pose` says, with the frustum of the intrinsics."""
        lens = self.intrinsics
        for camera in self._renderer.scene.camera:
            camera.pos[:] = self.pose[:3, 3]
            camera.forward[:] = self.pose[:3, 2]
            camera.up[:] = -self.pose[:3, 1]
            near = camera.frustum_near
            # Pixel centres are whole numbers: the picture's edges are half a pixel further out.
            left = near * (-0.5 - lens.cx) / lens.fx
            right = near * (lens.width - 0.5 - lens.cx) / lens.fx
            camera.frustum_center = (left + right) / 2.0
            camera.frustum_width = (right - left) / 2.0
            camera.frustum_top = near * (lens.cy + 0.5) / lens.fy
            camera.frustum_bottom = near * (lens.cy + 0.5 - lens.height) / lens.fy

    def _grey(self, fine: np.ndarray) -> np.ndarray:
        """[H, W] grey levels of the finer colours [each H, each W, 3]."""
        each, lens = self._fineness, self.intrinsics
        # Rows first and in whole numbers: four times as fast as all at once.
        rows = fine.reshape(lens.height, each, -1).sum(axis=1, dtype=np.uint16)
        pixels = rows.reshape(-1, 3 * each).astype(np.float32)
        return (pixels @ np.tile(_GREY / each**2, each)).reshape(lens.height, lens.width)

    def _depth(self) -> np.ndarray | None:
        if self._depth_noise is None:
            return None
        self._renderer.enable_depth_rendering()
        fine = self._renderer.render()
        self._renderer.disable_depth_rendering()
        exact = fine[self._fineness // 2 :: self._fineness, self._fineness // 2 :: self._fineness]
        noise = self._depth_noise * self._random.standard_normal(exact.shape, np.float32)
        noisy = exact + noise * exact**2
        return (np.rint(noisy / _DEPTH_STEP) * _DEPTH_STEP).astype(np.float32)
