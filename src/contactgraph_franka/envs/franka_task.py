"""The arm's pickup task: a Panda sweeps through a block and carries it to a goal in the air."""

import importlib.util
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Feedback, Observation
from contactgraph.envs.gripper_task import GRIPPER, GripperTask, check_count, fixed_layout
from contactgraph.envs.mujoco_world import SIMULATOR
from contactgraph_franka.envs.arm_model import (
    arm_xml,
    inverse_kinematics,
    mujoco,
    open_renderer,
)
from contactgraph_franka.envs.arm_world import BLOCK_MASS, ArmWorld
from contactgraph_franka.envs.pickup import (
    APPARENT_MASS,
    BLOCK,
    CONTACT_DISTANCE,
    GOAL_RADIUS,
    HIGH,
    MAX_FORCE,
    TARGET,
    Grasp,
    pickup_cost,
    sample_layout,
)

DT = 0.01
"""s"""
MAX_STEPS = 400
MAX_DISTRACTORS = 5
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


class FrankaTask(GripperTask):
    """The paper's arm task on MuJoCo; a `contactgraph.envs.Task`.

    Nodes are the hand (0), the block to pick up (1) and ``distractors`` further blocks on the
    table. The control ``[3]`` N is a force on the hand, which moves as a mass of 4 kg and keeps
    its orientation (`Impedance`); the fingers close by themselves on a block that passes between
    them (`GraspReflex`) and hold it by friction. The reward is the negative distance from block to
    goal, m. An episode has 400 steps of 0.01 s.

    ``fixed_seed`` is the seed of a scene whose goal and target position all episodes share; the
    hand and the distractors still vary, and the block faces the hand. None: each episode has its
    own. With ``render_mode`` "rgb_array", `render` returns pictures.

    Raises `InvalidInputError` if ``distractors`` is not in 0 to 5.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / DT)}  # noqa: RUF012

    def __init__(
        self,
        distractors: int = 0,
        grasp: Grasp = Grasp.FRICTION,
        render_mode: str | None = None,
        fixed_seed: int | None = None,
    ) -> None:
        check_count("distractors", distractors, 0, MAX_DISTRACTORS)
        if render_mode not in (None, "rgb_array"):
            raise InvalidInputError(f"render_mode must be rgb_array or None, found {render_mode!r}")
        super().__init__(
            2 + distractors,
            MAX_STEPS,
            float(np.max(HIGH)),
            dimension=3,
            dt=DT,
            max_force=MAX_FORCE,
            mass=APPARENT_MASS,
            fixed_seed=fixed_seed,
        )
        self._distractors = distractors
        self._grasp = grasp
        self._fixed = fixed_layout(fixed_seed, lambda rng: sample_layout(rng, MAX_DISTRACTORS))
        self.render_mode = render_mode
        self._camera: Camera | None = None
        self._arm = mujoco.MjModel.from_xml_string(arm_xml())

    def begin(self, seed: int) -> tuple[Scene, ArmWorld]:
        """Samples the scene of a seed, with everything at rest."""
        layout = sample_layout(np.random.default_rng(seed), self._distractors, self._fixed)
        joints = inverse_kinematics(self._arm, layout.hand, layout.yaw)
        world = ArmWorld(joints, layout.blocks, layout.block_yaw, DT, self._grasp)
        count = 1 + len(layout.blocks)
        scene = Scene(
            node_name=("hand", "block", *(f"distractor-{i}" for i in range(self._distractors))),
            node_type=("hand", *["block"] * (count - 1)),
            actuated=np.arange(count) == GRIPPER,
            dt=DT,
            dimension=3,
            goal=layout.goal,
            gravity=self._arm.opt.gravity.copy(),
            mass=np.array([APPARENT_MASS, *[BLOCK_MASS] * (count - 1)]),
            size=np.array([[np.nan] * 3, *[BLOCK] * (count - 1)]),
            metadata={
                "task": "franka",
                "distractors": self._distractors,
                "grasp": self._grasp.value,
                "goal_radius": GOAL_RADIUS,
                "contact_distance": CONTACT_DISTANCE,
                "simulator": SIMULATOR,
            },
        )
        return scene, world

    def step_under(
        self, feedback: Feedback
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advances by 0.01 s under the force ``feedback`` ``[3]`` N of every millisecond."""
        self.running()
        world = self._arm_world()
        mean = world.step_under(
            lambda part: self.bounded(feedback(part, world.position, world.velocity)),
            self.disturbance(),
        )
        return self.stepped({"control": mean})

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether the hand holds the block within 0.05 m of the goal."""
        at_goal = float(np.linalg.norm(position[TARGET] - scene.goal)) <= GOAL_RADIUS
        return at_goal and bool(contact[GRIPPER, TARGET])

    def cost_terms(self) -> ChainCost:
        """Cost of hand to block and block to goal."""
        return pickup_cost()

    def link_positions(self) -> np.ndarray:
        """[P, 3] m: the arm's joints from the base to the grasp point."""
        return self._arm_world().link_positions()

    def render(self) -> np.ndarray | None:
        """[480, 640, 3] uint8: a picture of the present state; None without a ``render_mode``.

        Raises `InvalidInputError` if MuJoCo has no OpenGL to render with.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws only with render_mode='rgb_array'")
            return None
        world = self._arm_world()
        if self._camera is None:
            self._camera = Camera(world.description)
        return self._camera.picture(world.data.qpos, np.asarray(self.scene.goal))

    def close(self) -> None:
        """Releases the renderer."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _arm_world(self) -> ArmWorld:
        world = self.world
        assert isinstance(world, ArmWorld)
        return world


class Camera:
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
