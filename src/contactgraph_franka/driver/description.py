"""Text about an arm's state and limits, for a person to read before it moves."""

from importlib.metadata import version

import numpy as np

from contactgraph_franka.driver.arm import JointLimits
from contactgraph_franka.driver.client import franky
from contactgraph_franka.driver.fingers import DELAY, FALSE_ALARM, MISS
from contactgraph_franka.safety.limits import SafetyLimits

Lines = list[tuple[str, str]]
"""Names and texts."""

_MODES = {
    "Idle": "idle: ready to move",
    "Move": "moving, under control of a program",
    "Guiding": "being guided by hand: let go of its buttons",
    "Reflex": "stopped by its reflex: it must recover first",
    "UserStopped": "its stop button is pressed: release it",
    "AutomaticErrorRecovery": "recovering from an error",
    "Other": "something else: see Desk, are its brakes open and its FCI active?",
}


def describe_arm(state: franky.RobotState, limits: JointLimits) -> Lines:
    """Versions and state of the arm."""
    errors = [
        name.replace("_", " ")
        for name in dir(state.current_errors)
        if not name.startswith("_") and getattr(state.current_errors, name) is True
    ]
    margin = np.minimum(state.q - limits.low, limits.high - state.q)
    nearest = int(np.argmin(margin))
    return [
        ("client", f"franky-control {version('franky-control')}"),
        ("mode", _MODES.get(state.robot_mode.name, state.robot_mode.name)),
        ("errors", ", ".join(errors) or "none"),
        ("joints", f"{_list(state.q)} rad"),
        ("limits", f"{_list(limits.low)} to {_list(limits.high)} rad"),
        ("nearest", f"joint {nearest + 1}, {margin[nearest]:.2f} rad from its limit"),
        ("hand", f"{state.m_ee:.2f} kg, {_point(state.F_T_EE.translation)} from the flange"),
        ("load", f"{state.m_load:.2f} kg"),
        ("packets", f"{100.0 * state.control_command_success_rate:.0f} % of the last arrived"),
    ]


def describe_gripper(width: float, largest: float, protocol: int) -> Lines:
    """State of the fingers: ``width`` m and ``largest`` m apart; 0 m before they were homed."""
    homed = f"of {1e3 * largest:.0f} mm" if largest else "not homed yet: do that in Desk first"
    return [
        ("gripper", f"version {protocol} of its protocol"),
        ("fingers", f"{1e3 * width:.0f} mm apart, {homed}"),
        (
            "contact",
            f"fingers that close and stop: {100 * FALSE_ALARM:.0f} % false alarms, "
            f"{100 * MISS:.0f} % missed, within {1e3 * DELAY:.0f} ms",
        ),
    ]


def describe_limits(
    limits: SafetyLimits, joints: JointLimits, reflex: tuple[float, float]
) -> Lines:
    """Limits of the control. ``reflex``: N m in a joint and N on the hand that stop the arm."""
    low, high = limits.workspace_low, limits.workspace_high
    return [
        ("force", f"at most {limits.max_force:g} N, changing by {limits.max_force_rate:g} N/s"),
        ("speed", f"of the hand at most {limits.max_speed:g} m/s"),
        ("workspace", f"{_point(np.array(low))} to {_point(np.array(high))}"),
        (
            "torque",
            f"at most {_list(joints.torque)} N m, changing by {joints.torque_rate:g} N m/s",
        ),
        ("deadlines", f"{1e3 * limits.longest_gap:g} ms for the loop, then it stops"),
        ("stop", f"within {1e3 * limits.stop_within:g} ms of a fault"),
        ("reflex", f"beyond {reflex[0]:g} N m in a joint, or {reflex[1]:g} N on the hand"),
    ]


def _list(numbers: np.ndarray) -> str:
    return ", ".join(f"{number:.4g}" for number in np.round(numbers, 2))


def _point(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{number:.3g}" for number in np.round(point, 4)) + ") m"
