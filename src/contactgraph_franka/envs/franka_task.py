"""The arm's pickup: a Panda takes a block up in one sweep and brings it to a goal in the air."""

import importlib.util
import re
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Feedback, Observation
from contactgraph.envs.gripper_task import GRIPPER, GripperTask, fixed_layout, fixed_metadata
from contactgraph_franka.envs.arm_model import SIMULATOR, inverse_kinematics, mujoco
from contactgraph_franka.envs.arm_world import BLOCK_MASS, ArmWorld, arm_alone
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


class FrankaTask(GripperTask):
    """The paper's arm task on MuJoCo; a `contactgraph.envs.Task`.

    Nodes are the hand (0), the block to pick up (1) and ``distractors`` further blocks on the
    table. The control ``[3]`` N is a force on the hand, which moves as a mass of 4 kg and keeps
    its orientation (`Impedance`); the fingers close by themselves on a block that passes between
    them (`GraspReflex`) and hold it by friction. The reward is the negative distance from block to
    goal, m. An episode always runs for 400 steps of 0.01 s.

    ``fixed_seed`` is the seed of a scene whose goal and place of the block every episode shares, so
    that only the hand and other blocks begin elsewhere (the block still faces the hand); None: each
    episode has its own. ``render_mode`` as in Gymnasium: with "rgb_array", `render` gives pictures.

    Raises `InvalidInputError` where ``distractors`` is not in 0 to 5.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / DT)}  # noqa: RUF012

    def __init__(
        self,
        distractors: int = 0,
        grasp: Grasp = Grasp.FRICTION,
        render_mode: str | None = None,
        fixed_seed: int | None = None,
    ) -> None:
        if not 0 <= distractors <= MAX_DISTRACTORS:
            raise InvalidInputError(
                f"distractors must be 0 to {MAX_DISTRACTORS}, found {distractors}"
            )
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
        )
        self._distractors = distractors
        self._grasp = grasp
        self._fixed_seed = fixed_seed
        self._fixed = fixed_layout(fixed_seed, lambda rng: sample_layout(rng, MAX_DISTRACTORS))
        self.render_mode = render_mode
        self._camera: Camera | None = None
        self._arm = mujoco.MjModel.from_xml_string(arm_alone())

    def begin(self, seed: int) -> tuple[Scene, ArmWorld]:
        """Samples the scene of a seed, with everything at rest."""
        layout = sample_layout(np.random.default_rng(seed), self._distractors, self._fixed)
        joints = inverse_kinematics(self._arm, layout.hand, layout.yaw)
        world = ArmWorld(joints, layout.blocks, layout.block_yaw, DT, self._grasp)
        count = 1 + len(layout.blocks)
        names = ("hand", "block", *(f"distractor-{i}" for i in range(self._distractors)))
        scene = Scene(
            node_name=names,
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
                "seed": seed,
                "distractors": self._distractors,
                "grasp": self._grasp.value,
                "goal_radius": GOAL_RADIUS,
                "contact_distance": CONTACT_DISTANCE,
                "simulator": SIMULATOR,
                **fixed_metadata(self._fixed_seed),
            },
        )
        return scene, world

    def step_under(
        self, feedback: Feedback
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Moves on by 0.01 s; the force ``[3]`` N is asked for every millisecond."""
        self.running()
        world = self._arm_world()
        mean = world.step_under(
            lambda part: self.bounded(feedback(part, world.position, world.velocity))
        )
        return self.stepped({"control": mean})

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether the hand holds the block within 0.05 m of the goal."""
        near = float(np.linalg.norm(position[TARGET] - scene.goal)) <= GOAL_RADIUS
        return near and bool(contact[GRIPPER, TARGET])

    def cost_terms(self) -> ChainCost:
        """Hand to block, block to goal."""
        return pickup_cost()

    def skeleton(self) -> np.ndarray:
        """[P, 3] m: the arm's joints, for drawing."""
        return self._arm_world().skeleton()

    def render(self) -> np.ndarray | None:
        """[480, 640, 3] uint8: a picture of now; None without a ``render_mode``.

        Raises `InvalidInputError` where MuJoCo has no OpenGL to draw with.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws only with render_mode='rgb_array'")
            return None
        world = self._arm_world()
        if self._camera is None:
            self._camera = Camera(world.description)
        return self._camera.picture(world.data.qpos, np.asarray(self.scene.goal))

    def close(self) -> None:
        """Ends the drawing."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _arm_world(self) -> ArmWorld:
        world = self.world
        assert isinstance(world, ArmWorld)
        return world


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
