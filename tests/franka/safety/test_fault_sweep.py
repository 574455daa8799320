"""A thousand short episodes with faults: commands stay within limits, lasting faults stop it."""

from collections.abc import Callable

import numpy as np
import pytest

from contactgraph_franka.safety import (
    FAULTS,
    Command,
    FakeRobot,
    Fault,
    SafeRobot,
    SafetyLimits,
    StopReason,
    faults,
)
from contactgraph_franka.safety.fake_robot import CYCLE

LIMITS = SafetyLimits()
EPISODES = 1000
TICKS = 55
STOP_TICKS = round(LIMITS.stop_within / CYCLE)
REASONS = {
    faults.nan_fault: StopReason.READING_NOT_FINITE,
    faults.frozen_fault: StopReason.READING_FROZEN,
    faults.jump_fault: StopReason.POSITION_JUMPED,
    faults.delay_fault: StopReason.READING_STALE,
    faults.lost_object_fault: StopReason.OBJECT_LOST,
    faults.lost_packet_fault: StopReason.CONNECTION_LOST,
    faults.late_plan_fault: StopReason.COMMAND_LATE,
}


def controller(robot: FakeRobot, push: np.ndarray, erratic: bool, tick: int) -> np.ndarray:
    """A force: a steady push, or one that jumps about beyond all limits."""
    return push * (40.0 if erratic and tick % 3 else 1.0) * (-1.0 if erratic and tick % 5 else 1.0)


def episode(seed: int, injected: tuple[Fault, ...]) -> tuple[np.ndarray, list[bool], SafeRobot]:
    """The forces that the robot held [TICKS, 3] N, and whether it braked in each tick."""
    random = np.random.default_rng(seed)
    push = random.uniform(-1.0, 1.0, 3)
    push *= random.uniform(5.0, 25.0) / np.linalg.norm(push)
    erratic = bool(random.random() < 0.3)
    robot = FakeRobot(seed, injected)
    safe = SafeRobot(robot, LIMITS, robot.clock)
    forces, braking = [], []
    for tick in range(TICKS):
        safe.read()
        late = robot.late
        force = controller(robot, push, erratic, tick)
        safe.send(None if late else Command(force, robot.clock()))
        forces.append(robot.applied.copy())
        braking.append(robot.braking)
        robot.advance()
    return np.array(forces), braking, safe


def assert_within_limits(forces: np.ndarray) -> None:
    assert np.isfinite(forces).all()
    assert np.linalg.norm(forces, axis=1).max() <= LIMITS.max_force * (1.0 + 1e-9)
    steps = np.diff(forces, axis=0, prepend=np.zeros((1, 3)))
    assert np.linalg.norm(steps, axis=1).max() <= LIMITS.max_force_rate * CYCLE * (1.0 + 1e-9)


def test_a_lasting_fault_stops_within_20_ms() -> None:
    stopped = dict.fromkeys(FAULTS, 0)
    for seed in range(EPISODES):
        kind = FAULTS[seed % len(FAULTS)]
        start = 10 + seed % 23
        forces, braking, safe = episode(seed, (kind(start, TICKS),))
        assert_within_limits(forces)
        assert not any(braking[:start])
        assert all(braking[start + STOP_TICKS :]), (kind.__name__, seed, start)
        assert safe.stop is not None and safe.stop.reason is REASONS[kind]
        stopped[kind] += 1
    assert min(stopped.values()) >= EPISODES // len(FAULTS)


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_of_a_tick_is_no_stop(kind: Callable[[int, int], Fault]) -> None:
    for seed in range(10):
        forces, braking, safe = episode(seed, (kind(12, 13),))
        assert_within_limits(forces)
        assert safe.stop is None and not any(braking)


def test_no_fault_no_stop() -> None:
    for seed in range(100):
        forces, braking, safe = episode(seed, ())
        assert_within_limits(forces)
        assert safe.stop is None and not any(braking)
        assert np.linalg.norm(forces, axis=1).max() > 2.0
