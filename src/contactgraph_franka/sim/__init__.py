"""Everything of a real arm but the arm: its protocol, a tagged block, a camera that renders it."""

from contactgraph_franka.sim.camera import CameraSettings as CameraSettings
from contactgraph_franka.sim.simulated_robot import RobotSimulator as RobotSimulator
from contactgraph_franka.sim.simulated_robot import SimulatedRobot as SimulatedRobot
from contactgraph_franka.sim.simulated_robot import attach as attach
from contactgraph_franka.sim.simulated_robot import open_camera as open_camera
