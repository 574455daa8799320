"""Pictures of the simulated arm, its blocks and the goal."""

import importlib.util
import re
from pathlib import Path

import numpy as np

from contactgraph_franka.envs.arm_model import mujoco, open_renderer

HEIGHT, WIDTH = 480, 640
"""Size of a picture, px."""
_LOOK_AT, _DISTANCE, _AZIMUTH, _ELEVATION = (0.4, 0.0, 0.25), 1.55, 135.0, -20.0
_MARKER_RADIUS, _MARKER_COLOUR = 0.015, np.array([0.2, 0.4, 0.9, 0.8], np.float32)
# Shadows and anti-aliasing take twenty times as long without a GPU.
_VISUAL = f"""<visual>
  <global offheight="{HEIGHT}" offwidth="{WIDTH}"/><quality shadowsize="0" offsamples="0"/>
  <headlight ambient=".5 .5 .5" diffuse=".5 .5 .5"/>
</visual>"""
_SKY = """<texture type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="8" height="48"/>"""
_MESHES = (*(f"link{index}" for index in range(8)), "hand", "finger", "finger")
"""The maker's meshes, in the order of the geoms that they replace."""
_GEOMS = re.compile(
    r'<geom class="link".*?/>|<geom name="palm".*?/>|<geom type="box" size="\.008 .*?/>', re.DOTALL
)


class ArmPicture:
    """Renders the scene of an `ArmWorld` from its MJCF ``description``.

    The package ``dm-robotics-panda``, if installed, provides the arm's meshes; capsules stand in
    otherwise. Raises `InvalidInputError` if MuJoCo has no OpenGL to render with.
    """

    def __init__(self, description: str) -> None:
        self._model = mujoco.MjModel.from_xml_string(_with_visuals(description))
        self._data = mujoco.MjData(self._model)
        self._view = mujoco.MjvCamera()
        self._view.lookat[:] = _LOOK_AT
        self._view.distance, self._view.azimuth = _DISTANCE, _AZIMUTH
        self._view.elevation = _ELEVATION
        self._renderer = open_renderer(self._model, HEIGHT, WIDTH, "pictures of the arm need")

    def picture(self, qpos: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """[480, 640, 3] uint8: joints and blocks at ``qpos``, and a marker at ``goal`` [3] m."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        self._renderer.update_scene(self._data, self._view)
        scene = self._renderer.scene
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom],
            mujoco.mjtGeom.mjGEOM_SPHERE,
            np.full(3, _MARKER_RADIUS),
            goal,
            np.eye(3).ravel(),
            _MARKER_COLOUR,
        )
        scene.ngeom += 1
        return self._renderer.render()

    def close(self) -> None:
        """Releases the renderer."""
        self._renderer.close()


def _with_visuals(description: str) -> str:
    folder = _mesh_folder()
    assets = _SKY
    if folder is not None:
        meshes = iter(_MESHES)
        description = _GEOMS.sub(
            lambda _: f'<geom type="mesh" mesh="{next(meshes)}" rgba=".95 .95 .96 1"/>', description
        )
        assets += "".join(
            f'<mesh name="{name}" file="{folder / name}.obj"/>' for name in sorted(set(_MESHES))
        )
    return description.replace("<worldbody>", f"{_VISUAL}<asset>{assets}</asset><worldbody>", 1)


def _mesh_folder() -> Path | None:
    """The folder of the maker's meshes, if a package that has them is installed."""
    if importlib.util.find_spec("dm_robotics") is None:
        return None
    package = importlib.util.find_spec("dm_robotics.panda")
    if package is None or package.origin is None:
        return None
    folder = Path(package.origin).parent / "assets" / "panda"
    return folder if all((folder / f"{name}.obj").is_file() for name in _MESHES) else None
