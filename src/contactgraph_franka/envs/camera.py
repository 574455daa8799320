"""Pictures of the arm by MuJoCo's own renderer, without a screen."""

import importlib.util
import re
import warnings
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.envs.engine import mujoco

HEIGHT, WIDTH = 480, 640
_LOOK_AT, _DISTANCE, _AZIMUTH, _ELEVATION = (0.4, 0.0, 0.25), 1.55, 135.0, -20.0
_GOAL_RADIUS, _GOAL_COLOUR = 0.015, np.array([0.2, 0.4, 0.9, 0.8], np.float32)
# Shadows and smoothing take twenty times as long where the processor draws.
_VISUAL = f"""<visual>
  <global offheight="{HEIGHT}" offwidth="{WIDTH}"/><quality shadowsize="0" offsamples="0"/>
  <headlight ambient=".5 .5 .5" diffuse=".5 .5 .5"/>
</visual>"""
_SKY = """<texture type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="8" height="48"/>"""
_ARM = (*(f"link{index}" for index in range(8)), "hand", "finger", "finger")
"""The maker's meshes, in the order of the shapes that stand for them."""
_SHAPES = re.compile(
    r'<geom class="link".*?/>|<geom name="palm".*?/>|<geom type="box" size="\.008 .*?/>', re.DOTALL
)


class Camera:
    """Sees the scene of an `ArmWorld`, with the arm as its maker shows it where that is known.

    ``description`` is the world's own. The package ``dm-robotics-panda``, if it is installed, has
    the arm's surfaces; else capsules stand for its links. Raises `InvalidInputError` where MuJoCo
    has no OpenGL to draw with.
    """

    def __init__(self, description: str) -> None:
        self._model = mujoco.MjModel.from_xml_string(_with_looks(description))
        self._data = mujoco.MjData(self._model)
        self._view = mujoco.MjvCamera()
        self._view.lookat[:] = _LOOK_AT
        self._view.distance, self._view.azimuth = _DISTANCE, _AZIMUTH
        self._view.elevation = _ELEVATION
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # GLFW warns where it fails
                self._renderer = mujoco.Renderer(self._model, HEIGHT, WIDTH)
        except Exception as error:
            raise InvalidInputError(
                "pictures of the arm need OpenGL without a screen: set MUJOCO_GL=egl before Python "
                "starts (Debian: apt install libegl1 libegl-mesa0 libgl1-mesa-dri)"
            ) from error

    def picture(self, places: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """[480, 640, 3] uint8: joints and blocks at ``places``, a ``qpos``; the ``goal`` [3] m."""
        self._data.qpos[:] = places
        mujoco.mj_kinematics(self._model, self._data)
        self._renderer.update_scene(self._data, self._view)
        self._mark(goal)
        return self._renderer.render()

    def close(self) -> None:
        """Gives OpenGL back what it needs."""
        self._renderer.close()

    def _mark(self, goal: np.ndarray) -> None:
        scene = self._renderer.scene
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom],
            mujoco.mjtGeom.mjGEOM_SPHERE,
            np.full(3, _GOAL_RADIUS),
            goal,
            np.eye(3).ravel(),
            _GOAL_COLOUR,
        )
        scene.ngeom += 1


def _with_looks(description: str) -> str:
    folder = _meshes()
    assets = _SKY
    if folder is not None:
        meshes = iter(_ARM)
        description = _SHAPES.sub(
            lambda _: f'<geom type="mesh" mesh="{next(meshes)}" rgba=".95 .95 .96 1"/>', description
        )
        assets += "".join(
            f'<mesh name="{name}" file="{folder / name}.obj"/>' for name in sorted(set(_ARM))
        )
    return description.replace("<worldbody>", f"{_VISUAL}<asset>{assets}</asset><worldbody>", 1)


def _meshes() -> Path | None:
    """The folder of the maker's surfaces, where a package that has them is installed."""
    if importlib.util.find_spec("dm_robotics") is None:
        return None
    package = importlib.util.find_spec("dm_robotics.panda")
    if package is None or package.origin is None:
        return None
    folder = Path(package.origin).parent / "assets" / "panda"
    return folder if all((folder / f"{name}.obj").is_file() for name in _ARM) else None
