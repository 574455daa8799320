"""The arm's task on MuJoCo; importing it needs the extra ``mujoco``."""

from contactgraph_franka.envs.arm_world import ArmWorld as ArmWorld
from contactgraph_franka.envs.arm_world import Grasp as Grasp
from contactgraph_franka.envs.franka_task import FrankaTask as FrankaTask
