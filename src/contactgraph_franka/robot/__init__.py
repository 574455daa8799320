"""The path to a real arm: what a robot is, its safety limits, and a fake one to test with."""

from contactgraph_franka.robot.contract import Command as Command
from contactgraph_franka.robot.contract import Robot as Robot
from contactgraph_franka.robot.contract import RobotReading as RobotReading
from contactgraph_franka.robot.fake_robot import FakeRobot as FakeRobot
from contactgraph_franka.robot.faults import FAULTS as FAULTS
from contactgraph_franka.robot.faults import Fault as Fault
from contactgraph_franka.robot.limits import SafetyLimits as SafetyLimits
from contactgraph_franka.robot.safe_robot import SafeRobot as SafeRobot
from contactgraph_franka.robot.safety_filter import SafetyFilter as SafetyFilter
from contactgraph_franka.robot.stop import Stop as Stop
from contactgraph_franka.robot.stop import StopReason as StopReason
