"""The arm's task on MuJoCo; importing it needs the extra ``mujoco``."""

from contactgraph.tasks.mujoco.arm_world import ArmWorld as ArmWorld
from contactgraph.tasks.mujoco.arm_world import Grasp as Grasp
from contactgraph.tasks.mujoco.franka import FrankaTask as FrankaTask
