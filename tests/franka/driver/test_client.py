"""Connection and position control with stubs of the arm."""

import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("franky", reason="needs pip install 'contactgraph[robot]'")

from contactgraph.data import InvalidInputError
from contactgraph_franka.driver.client import check_target, franky, move_to_pose
from contactgraph_franka.driver.franka_robot import FrankaRobot

TARGET = np.array([0.45, 0.0, 0.25])


class PlannerFailures:
    """An arm at rest, whose client finds no motion ``count`` times."""

    def __init__(self, count: int) -> None:
        self.left, self.moved = count, 0
        self.state = SimpleNamespace(dq=np.zeros(7))

    def move(self, motion: object) -> None:
        self.left -= 1
        if self.left >= 0:
            raise RuntimeError("Motion planner failed with error code -111")
        self.moved += 1


@pytest.mark.parametrize(("count", "moved"), [(0, 1), (2, 1), (3, 0)])
def test_motion_planner_is_called_again_after_a_failure(count: int, moved: int) -> None:
    arm = PlannerFailures(count)
    with nullcontext() if moved else pytest.raises(RuntimeError, match="Motion planner failed"):
        move_to_pose(arm, TARGET, 0.0, 0.1, franky.Affine(), time.monotonic)
    assert arm.moved == moved


@pytest.mark.parametrize(
    ("position", "speed", "text"),
    [
        ([0.5, 0.1], 0.1, r"position must be \[3\] m, and yaw rad, found \[0.5, 0.1\]"),
        ([0.5, 0.1, np.nan], 0.1, r"position must be \[3\] m"),
        (TARGET, 0.0, "speed must be above 0 and at most 1, found 0.0"),
    ],
)
def test_invalid_targets(position: list[float], speed: float, text: str) -> None:
    with pytest.raises(InvalidInputError, match=text):
        check_target(position, 0.0, speed)


@pytest.mark.parametrize("address", ["127.0.0.99", "no-such-arm.invalid"])
def test_no_arm_at_an_address(address: str) -> None:
    with pytest.raises(InvalidInputError, match=f"no arm answers at {address}: .* FCI") as caught:
        FrankaRobot(address)
    assert "\n" not in str(caught.value)
