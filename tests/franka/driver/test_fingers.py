"""When fingers close, and what their width tells."""

import math

import numpy as np
import pytest

from contactgraph_franka.driver.fingers import DELAY, OPEN_WIDTH, FingerContact, GraspTrigger

LOOK = 0.01
SPEED = 0.11
"""m/s, of fingers that are told 0.1."""
SEEN = np.ones(1, bool)


def closed(until: float, start: float = 0.06, seconds: float = 1.0) -> list[tuple[float, float]]:
    """(s, value) while fingers close from ``start`` m until something stops them at ``until`` m."""
    sensor, told = FingerContact(), []
    for look in range(round(seconds / LOOK)):
        now = look * LOOK
        sensor.step(max(start - SPEED * now, until), now, closing=True)
        told.append((now, sensor.value))
    return told


@pytest.mark.parametrize("block", [0.02, 0.04, 0.05])
def test_fingers_that_stop_hold_something(block: float) -> None:
    touch = (0.06 - block) / SPEED
    told = closed(until=block)
    assert all(value != 1.0 for now, value in told if now < touch)
    assert all(value == 1.0 for now, value in told if now > touch + DELAY)


def test_fingers_that_meet_hold_nothing() -> None:
    values = [value for _, value in closed(until=0.0)]
    assert 1.0 not in values and values[-1] == 0.0 and values.count(0.0) > 50


def test_fingers_that_have_not_moved_yet_tell_nothing() -> None:
    sensor = FingerContact()
    for look in range(50):
        sensor.step(0.06, look * LOOK, closing=True)
        assert math.isnan(sensor.value)


def test_fingers_that_open_or_rest_tell_nothing() -> None:
    sensor = FingerContact()
    for look in range(100):
        sensor.step(max(0.06 - SPEED * look * LOOK, 0.04), look * LOOK, closing=True)
    assert sensor.value == 1.0
    sensor.step(0.04, 1.0, closing=False)
    assert math.isnan(sensor.value)


def swept(
    miss: float, speed: float = 0.4, block: float = 0.04
) -> tuple[float | None, GraspTrigger]:
    """Passes a block at ``speed`` m/s, ``miss`` m beside it: how far, m, the hand was past the
    block's centre as fingers of the maker's speed met on it; None where they never did."""
    reflex, width, way = GraspTrigger(lag=0.03), OPEN_WIDTH, -0.3
    since_decided, velocity = 0.0, np.array([[speed, 0.0, 0.0]])
    met = None
    while way < 0.1:
        if reflex.step(np.array([[-way, miss, 0.0]]), velocity, SEEN, width):
            since_decided += 0.001
            if since_decided > 0.03:
                width -= SPEED * 0.001
        if met is None and width <= block:
            met = way
        way += speed * 0.001
    return met, reflex


@pytest.mark.parametrize("speed", [0.1, 0.4, 0.8])
@pytest.mark.parametrize("miss", [0.0, 0.006])
def test_fingers_meet_on_a_block_that_passes(speed: float, miss: float) -> None:
    met, reflex = swept(miss, speed)
    # Behind the centre, so that they are still wide where they come to the block.
    assert met is not None and met == pytest.approx(0.012, abs=0.002)
    assert reflex.block == 0


def test_a_block_that_passes_too_far_off_is_let_pass() -> None:
    met, reflex = swept(0.03)
    assert met is None and not reflex.closed


def test_a_hand_that_moves_away_or_sees_nothing_keeps_its_fingers_open() -> None:
    reflex = GraspTrigger()
    near = np.array([[0.05, 0.0, 0.0]])
    assert not reflex.step(near, np.array([[-0.4, 0.0, 0.0]]), SEEN, OPEN_WIDTH)
    assert not reflex.step(near, np.array([[0.4, 0.0, 0.0]]), ~SEEN, OPEN_WIDTH)
    assert reflex.step(near, np.array([[0.4, 0.0, 0.0]]), SEEN, OPEN_WIDTH)


def test_what_is_held_is_held_until_it_is_seen_elsewhere() -> None:
    reflex, still = GraspTrigger(), np.zeros((1, 3))
    here, there = np.zeros((1, 3)), np.array([[0.0, 0.2, 0.0]])
    assert reflex.step(here, still, SEEN, 0.04)
    # Hidden by the hand, the block is where it was.
    assert reflex.step(there, still, ~SEEN, 0.04)
    assert not reflex.step(there, still, SEEN, 0.04)


def test_fingers_that_met_nothing_open_again() -> None:
    reflex = GraspTrigger()
    assert reflex.step(np.zeros((1, 3)), np.zeros((1, 3)), SEEN, OPEN_WIDTH)
    assert reflex.step(np.zeros((1, 3)), np.zeros((1, 3)), SEEN, 0.02)
    assert not reflex.step(np.zeros((1, 3)), np.zeros((1, 3)), SEEN, 0.001)


def test_the_nearest_of_several_is_the_one_that_is_told() -> None:
    reflex = GraspTrigger()
    offset = np.array([[0.3, 0.0, 0.0], [0.0, 0.005, 0.0]])
    assert reflex.step(offset, np.zeros((2, 3)), np.ones(2, bool), OPEN_WIDTH)
    assert reflex.block == 1
