"""Closing of the fingers, and contact from their width."""

import math

import numpy as np
import pytest

from contactgraph_franka.driver.fingers import DELAY, OPEN_WIDTH, FingerContact, GraspTrigger

READ = 0.01
SPEED = 0.11
"""m/s, for a command of 0.1."""
TRACKED = np.ones(1, bool)


def closed(until: float, start: float = 0.06, seconds: float = 1.0) -> list[tuple[float, float]]:
    """(s, value) while fingers close from ``start`` m until something stops them at ``until`` m."""
    sensor, values = FingerContact(), []
    for read in range(round(seconds / READ)):
        now = read * READ
        sensor.step(max(start - SPEED * now, until), now, closing=True)
        values.append((now, sensor.value))
    return values


@pytest.mark.parametrize("block", [0.02, 0.04, 0.05])
def test_contact_where_fingers_stop(block: float) -> None:
    touch = (0.06 - block) / SPEED
    values = closed(until=block)
    assert all(value != 1.0 for now, value in values if now < touch)
    assert all(value == 1.0 for now, value in values if now > touch + DELAY)


def test_no_contact_where_fingers_meet() -> None:
    values = [value for _, value in closed(until=0.0)]
    assert 1.0 not in values and values[-1] == 0.0 and values.count(0.0) > 50


def test_unknown_unless_the_fingers_close_and_move() -> None:
    sensor = FingerContact()
    for read in range(150):
        moved = SPEED * READ * max(read - 50, 0)
        sensor.step(max(0.06 - moved, 0.04), read * READ, closing=True)
        assert read > 50 or math.isnan(sensor.value)
    assert sensor.value == 1.0
    sensor.step(0.04, 1.5, closing=False)
    assert math.isnan(sensor.value)


def sweep(
    miss: float, speed: float = 0.4, block: float = 0.04
) -> tuple[float | None, GraspTrigger]:
    """Passes a block at ``speed`` m/s, ``miss`` m beside it; the hand's distance past its centre,
    m, when the fingers meet on it, None where they do not."""
    trigger, width, x = GraspTrigger(lag=0.03), OPEN_WIDTH, -0.3
    since_decided, velocity = 0.0, np.array([[speed, 0.0, 0.0]])
    met = None
    while x < 0.1:
        if trigger.step(np.array([[-x, miss, 0.0]]), velocity, TRACKED, width):
            since_decided += 0.001
            if since_decided > 0.03:
                width -= SPEED * 0.001
        if met is None and width <= block:
            met = x
        x += speed * 0.001
    return met, trigger


@pytest.mark.parametrize("speed", [0.1, 0.4, 0.8])
@pytest.mark.parametrize("miss", [0.0, 0.006])
def test_fingers_meet_on_a_passing_block(speed: float, miss: float) -> None:
    met, trigger = sweep(miss, speed)
    # Behind the centre, so that they are still wide on arrival at the block.
    assert met is not None and met == pytest.approx(0.012, abs=0.002)
    assert trigger.block == 0


def test_distant_block_is_not_grasped() -> None:
    met, trigger = sweep(0.03)
    assert met is None and not trigger.closed


def test_fingers_stay_open_for_receding_or_untracked_blocks() -> None:
    trigger = GraspTrigger()
    near = np.array([[0.05, 0.0, 0.0]])
    assert not trigger.step(near, np.array([[-0.4, 0.0, 0.0]]), TRACKED, OPEN_WIDTH)
    assert not trigger.step(near, np.array([[0.4, 0.0, 0.0]]), ~TRACKED, OPEN_WIDTH)
    assert trigger.step(near, np.array([[0.4, 0.0, 0.0]]), TRACKED, OPEN_WIDTH)


def test_grasp_ends_where_the_grasped_block_is_measured_elsewhere() -> None:
    trigger, still, both = GraspTrigger(), np.zeros((2, 3)), np.ones(2, bool)
    here, there = (np.array([[0.3, 0.0, 0.0], [0.0, y, 0.0]]) for y in (0.005, 0.2))
    assert trigger.step(here, still, both, OPEN_WIDTH) and trigger.block == 1
    # An untracked block is hidden by the hand.
    assert trigger.step(there, still, ~both, 0.04)
    assert not trigger.step(there, still, both, 0.04)


def test_fingers_that_met_nothing_open_again() -> None:
    trigger = GraspTrigger()
    assert trigger.step(np.zeros((1, 3)), np.zeros((1, 3)), TRACKED, OPEN_WIDTH)
    assert trigger.step(np.zeros((1, 3)), np.zeros((1, 3)), TRACKED, 0.02)
    assert not trigger.step(np.zeros((1, 3)), np.zeros((1, 3)), TRACKED, 0.001)
