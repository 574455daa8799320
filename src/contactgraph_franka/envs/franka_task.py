"""The arm's pickup task: a Panda sweeps through a block and carries it to a goal in the air.

MuJoCo is imported once a task is made.
"""

from functools import partial
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.data.lookup import choice
from contactgraph.envs.contract import ChainCost, Conditions, Feedback, Observation
from contactgraph.envs.exploration import ExplorationPolicy
from contactgraph.envs.gripper_task import GRIPPER, GripperTask, check_count, fixed_layout
from contactgraph_franka.envs.expert import FrankaExpert
from contactgraph_franka.envs.pickup import (
    APPARENT_MASS,
    BLOCK,
    BLOCK_MASS,
    CONTACT_DISTANCE,
    GOAL_RADIUS,
    HIGH,
    MAX_FORCE,
    TARGET,
    Grasp,
    pickup_cost,
    sample_layout,
)

if TYPE_CHECKING:
    from contactgraph_franka.envs.arm_picture import ArmPicture
    from contactgraph_franka.envs.arm_world import ArmWorld

DT = 0.01
"""s"""
MAX_STEPS = 400
MAX_DISTRACTORS = 5


class FrankaTask(GripperTask):
    """A robot arm picks up a block and takes it to a goal (MuJoCo).

    The paper's arm task. Nodes are the hand (0), the block to pick up (1) and ``distractors``
    further blocks on the table. The control ``[3]`` N is a force on the hand, which moves as a mass
    of 4 kg and keeps its orientation (`Impedance`); the fingers close by themselves on a block that
    passes between them (`GraspReflex`) and hold it by ``grasp``: friction, or a weld. The reward is
    the negative distance from block to goal, m. An episode has 400 steps of 0.01 s.

    ``fixed_seed`` is the seed of a scene whose goal and target position all episodes share; the
    hand and the distractors still vary, and the block faces the hand. None: each episode has its
    own. With ``render_mode`` "rgb_array", `render` returns pictures.

    Raises `InvalidInputError` if ``distractors`` is not in 0 to 5, or MuJoCo is missing.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / DT)}  # noqa: RUF012
    name = "franka"
    expert = FrankaExpert
    explorer = partial(
        ExplorationPolicy, deviation=2.0, correlation_steps=25.0, stiffness=20.0, damping=8.0
    )
    """For a hand of 4 kg and steps of 0.01 s: the position spreads by 0.1 m on each axis."""
    horizon = 50
    max_force = MAX_FORCE
    conditions: Conditions = (("as trained", {}), ("5 distractors", {"distractors": 5}))

    def __init__(
        self,
        distractors: int = 0,
        grasp: str = Grasp.FRICTION,
        render_mode: str | None = None,
        fixed_seed: int | None = None,
    ) -> None:
        # Raises `InvalidInputError` if MuJoCo is missing.
        from contactgraph_franka.envs.arm_model import arm_xml, mujoco

        check_count("distractors", distractors, 0, MAX_DISTRACTORS)
        if render_mode not in (None, "rgb_array"):
            raise InvalidInputError(f"render_mode must be rgb_array or None, found {render_mode!r}")
        super().__init__(
            2 + distractors,
            MAX_STEPS,
            float(np.max(HIGH)),
            dimension=3,
            dt=DT,
            mass=APPARENT_MASS,
            fixed_seed=fixed_seed,
        )
        self._distractors = distractors
        self._grasp = choice("grasp", grasp, {each.value: each for each in Grasp})
        self._fixed = fixed_layout(fixed_seed, lambda rng: sample_layout(rng, MAX_DISTRACTORS))
        self.render_mode = render_mode
        self._camera: ArmPicture | None = None
        self._arm = mujoco.MjModel.from_xml_string(arm_xml())

    def begin(self, seed: int) -> "tuple[Scene, ArmWorld]":
        """Samples the scene of a seed, with everything at rest."""
        from contactgraph_franka.envs.arm_model import inverse_kinematics
        from contactgraph_franka.envs.arm_world import ArmWorld

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
                "distractors": self._distractors,
                "grasp": self._grasp.value,
                "goal_radius": GOAL_RADIUS,
                "contact_distance": CONTACT_DISTANCE,
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
            from contactgraph_franka.envs.arm_picture import ArmPicture

            self._camera = ArmPicture(world.description)
        return self._camera.picture(world.data.qpos, np.asarray(self.scene.goal))

    def close(self) -> None:
        """Releases the renderer."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _arm_world(self) -> "ArmWorld":
        return cast("ArmWorld", self.world)
