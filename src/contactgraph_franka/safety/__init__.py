"""The robot interface, its safety limits, and a fake robot with faults for tests."""

from contactgraph_franka.safety.fake_robot import FakeRobot as FakeRobot
from contactgraph_franka.safety.faults import FAULTS as FAULTS
from contactgraph_franka.safety.faults import Fault as Fault
from contactgraph_franka.safety.filter import SafeRobot as SafeRobot
from contactgraph_franka.safety.filter import SafetyFilter as SafetyFilter
from contactgraph_franka.safety.limits import SafetyLimits as SafetyLimits
from contactgraph_franka.safety.robot import Command as Command
from contactgraph_franka.safety.robot import Robot as Robot
from contactgraph_franka.safety.robot import RobotReading as RobotReading
from contactgraph_franka.safety.robot import Stop as Stop
from contactgraph_franka.safety.robot import StopReason as StopReason
