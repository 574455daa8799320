"""The path to a real arm: what a robot is, its safety limits, and a fake one to test with."""

from contactgraph.robot.contract import Command as Command
from contactgraph.robot.contract import Robot as Robot
from contactgraph.robot.contract import RobotReading as RobotReading
from contactgraph.robot.fake_robot import FakeRobot as FakeRobot
from contactgraph.robot.faults import FAULTS as FAULTS
from contactgraph.robot.faults import Fault as Fault
from contactgraph.robot.limits import SafetyLimits as SafetyLimits
from contactgraph.robot.safe_robot import SafeRobot as SafeRobot
from contactgraph.robot.safety_filter import SafetyFilter as SafetyFilter
from contactgraph.robot.stop import Stop as Stop
from contactgraph.robot.stop import StopReason as StopReason
