"""The simulated robot: the arm behind its real protocol, tagged blocks and a rendered camera."""

from contactgraph_franka.sim.camera import CameraSettings as CameraSettings
from contactgraph_franka.sim.simulated_robot import RobotSimulator as RobotSimulator
from contactgraph_franka.sim.simulated_robot import SimulatedRobot as SimulatedRobot
from contactgraph_franka.sim.simulated_robot import attach as attach
from contactgraph_franka.sim.simulated_robot import open_camera as open_camera
