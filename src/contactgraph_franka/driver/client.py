"""Connection and position control by franky, the arm's client, which only this module imports."""

import math
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from contactgraph.data import InvalidInputError

try:
    import franky as franky
except ModuleNotFoundError as error:
    raise InvalidInputError("an arm needs franky: pip install 'contactgraph[robot]'") from error

_TIMEOUT = 5.0
"""s, of a connection."""
_ATTEMPTS = 3
"""Calls of the motion planner."""
_RESTING = 2e-4
"""rad/s: below it, a joint is at rest."""
_SETTLED_WITHIN = 2.0
"""s"""

CLIENT_FAULTS = (franky.Exception, franky.TorqueSignalTimeoutException, RuntimeError)
"""All errors of the client whose cause is the arm or the network, not the program. Network errors
reach Python as `RuntimeError`."""
PLANNER_FAULT = "Motion planner failed"
"""Text of the one such error with another cause: the client's planner found no motion. It occurs
once in 20 motions, and another attempt some milliseconds later succeeds."""

Connection = TypeVar("Connection")


def connect(address: str) -> franky.Robot:
    """Connects to the arm at ``address``. Nothing moves.

    Raises `InvalidInputError` where no arm answers, or one with another protocol.
    """
    return _with_timeout(
        lambda: franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore), address, "arm"
    )


def connect_gripper(address: str) -> franky.Gripper:
    """Connects to the gripper of the arm at ``address``; raises like `connect`."""
    return _with_timeout(lambda: franky.Gripper(address), address, "gripper")


def first_state(device: "franky.Robot | franky.Gripper", address: str) -> Any:
    """The state of ``device``, an arm or its gripper.

    Raises `InvalidInputError` where it is connected, but sends none.
    """
    try:
        return device.state
    except CLIENT_FAULTS as error:
        raise InvalidInputError(
            f"{address} answers, but then sends no state: {error} (does something on the way, or "
            "on this machine, keep UDP packets out?)"
        ) from error


def _with_timeout(open_connection: Callable[[], Connection], address: str, what: str) -> Connection:
    # In a thread: the client waits for a minute for an address that swallows packets.
    answers: list[Connection | Exception] = []

    def attempt() -> None:
        try:
            answers.append(open_connection())
        except Exception as error:  # raised below, in the caller's thread
            answers.append(error)

    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    thread.join(_TIMEOUT)
    if not answers:
        raise InvalidInputError(
            f"no {what} answers at {address} within {_TIMEOUT:.0f} s: is the cable in, the arm "
            "on, and this the address of the arm itself?"
        )
    answer = answers[0]
    if isinstance(answer, franky.IncompatibleVersionException):
        raise InvalidInputError(
            f"the {what} at {address} speaks another version of the protocol than this client, "
            f"which is made for the FR3: {answer}"
        ) from answer
    if isinstance(answer, Exception):
        raise InvalidInputError(
            f"no {what} answers at {address}: {answer} (the arm must be on, unlocked, and its FCI "
            "activated in Desk)"
        ) from answer
    return answer


def check_target(position: np.ndarray, yaw: float, speed: float) -> None:
    """Raises `InvalidInputError` where these are not valid arguments of `move_to_pose`."""
    target = np.asarray(position, dtype=np.float64)
    if target.shape != (3,) or not np.isfinite([*target, yaw]).all():
        raise InvalidInputError(f"position must be [3] m, and yaw rad, found {position}, {yaw}")
    if not 0.0 < speed <= 1.0:
        raise InvalidInputError(f"speed must be above 0 and at most 1, found {speed}")


def move_to_pose(
    arm: "franky.Robot",
    position: np.ndarray,
    yaw: float,
    speed: float,
    point: "franky.Affine",
    clock: Callable[[], float],
) -> None:
    """Moves ``point``, given in the hand's frame, to ``position`` [3] m, and waits for the end.

    The hand points down, turned by ``yaw`` rad; ``speed`` is the share of the arm's own limits.
    Raises the errors of the arm's client.
    """
    down = np.array([math.cos(yaw / 2.0), math.sin(yaw / 2.0), 0.0, 0.0])
    target = franky.Affine(np.asarray(position, dtype=np.float64), down)
    for attempt in range(1, _ATTEMPTS + 1):
        motion = franky.CartesianMotion(target, relative_dynamics_factor=speed, ee_frame=point)
        try:
            arm.move(motion)
            break
        except CLIENT_FAULTS as error:
            if PLANNER_FAULT not in str(error) or attempt == _ATTEMPTS:
                raise
        _settle(arm, clock)
    _settle(arm, clock)


def _settle(arm: "franky.Robot", clock: Callable[[], float]) -> None:
    """Waits until ``arm`` is at rest, for at most 2 s: it follows its commands with a lag."""
    until = clock() + _SETTLED_WITHIN
    while np.abs(arm.state.dq).max() > _RESTING and clock() < until:
        pass  # reading a state takes a cycle
