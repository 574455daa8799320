"""The one file that imports franky, the arm's client, and how a connection is made."""

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

_PATIENCE = 5.0
"""s: for so long a connection may take."""

CLIENT_FAULTS = (franky.Exception, franky.TorqueSignalTimeoutException, RuntimeError)
"""All that the client raises where the arm or the way to it is at fault, not a program. Bare
network errors reach Python as `RuntimeError`."""
PLANNER_FAULT = "Motion planner failed"
"""Words of the one such error that is no network's: no motion was found from where the arm is. It
comes once in 20 motions, and another try, some milliseconds later, finds one."""


Connection = TypeVar("Connection")


def connect(address: str) -> franky.Robot:
    """The arm at ``address``. Nothing moves.

    Raises `InvalidInputError` where none answers, or one that speaks another protocol.
    """
    return _within_patience(
        lambda: franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore), address, "arm"
    )


def first_state(arm: "franky.Robot | franky.Gripper", address: str) -> Any:
    """The state of ``arm``, be it an arm or its gripper.

    Raises `InvalidInputError` where it was there, but sends none.
    """
    try:
        return arm.state
    except CLIENT_FAULTS as error:
        raise InvalidInputError(
            f"{address} answers, but then sends no state: {error} (does something on the way, or "
            "on this machine, keep UDP packets out?)"
        ) from error


def connect_gripper(address: str) -> franky.Gripper:
    """The gripper of the arm at ``address``; raises as `connect` does."""
    return _within_patience(lambda: franky.Gripper(address), address, "gripper")


def _within_patience(connect: Callable[[], Connection], address: str, what: str) -> Connection:
    # In a thread: to an address that swallows packets the client waits for a minute.
    found: list[Connection | Exception] = []

    def attempt() -> None:
        try:
            found.append(connect())
        except Exception as error:  # told below, in the caller's thread
            found.append(error)

    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    thread.join(_PATIENCE)
    if not found:
        raise InvalidInputError(
            f"no {what} answers at {address} within {_PATIENCE:.0f} s: is the cable in, the arm "
            "on, and this the address of the arm itself?"
        )
    answer = found[0]
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


_ATTEMPTS = 3
"""To find a motion."""
_RESTING = 2e-4
"""rad/s: a joint that is slower rests."""
_SETTLED_WITHIN = 2.0
"""s"""


def check_transfer(position: np.ndarray, yaw: float, speed: float) -> None:
    """Raises `InvalidInputError` where these do not say where to, or how fast."""
    place = np.asarray(position, dtype=np.float64)
    if place.shape != (3,) or not np.isfinite([*place, yaw]).all():
        raise InvalidInputError(f"position must be [3] m, and yaw rad, found {position}, {yaw}")
    if not 0.0 < speed <= 1.0:
        raise InvalidInputError(f"speed must be above 0 and at most 1, found {speed}")


def transfer(
    arm: "franky.Robot",
    position: np.ndarray,
    yaw: float,
    speed: float,
    point: "franky.Affine",
    clock: Callable[[], float],
) -> None:
    """Moves ``point``, as seen from the hand's own frame, to ``position`` [3] m, and waits for it.

    The hand points down, turned by ``yaw`` rad; ``speed`` is the share of the arm's own limits.
    Raises what the arm's client does.
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
    """Waits until ``arm`` rests, for at most 2 s: it follows what it is told with a lag."""
    until = clock() + _SETTLED_WITHIN
    while np.abs(arm.state.dq).max() > _RESTING and clock() < until:
        pass  # a state takes its tick to come
