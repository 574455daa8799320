"""Short episodes with faults: commands stay within limits, and lasting faults stop the robot."""

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
CYCLES = 55
STOP_CYCLES = round(LIMITS.stop_within / CYCLE)
REASONS = {
    faults.nan_fault: StopReason.READING_NOT_FINITE,
    faults.frozen_fault: StopReason.READING_FROZEN,
    faults.jump_fault: StopReason.POSITION_JUMPED,
    faults.delay_fault: StopReason.READING_STALE,
    faults.lost_object_fault: StopReason.OBJECT_LOST,
    faults.lost_packet_fault: StopReason.CONNECTION_LOST,
    faults.late_plan_fault: StopReason.COMMAND_LATE,
}


def requested(push: np.ndarray, erratic: bool, cycle: int) -> np.ndarray:
    """A constant force, or one that jumps beyond all limits."""
    return (
        push * (40.0 if erratic and cycle % 3 else 1.0) * (-1.0 if erratic and cycle % 5 else 1.0)
    )


def episode(seed: int, injected: tuple[Fault, ...]) -> tuple[np.ndarray, list[bool], SafeRobot]:
    """The forces applied [CYCLES, 3] N, and whether the robot braked in each cycle."""
    random = np.random.default_rng(seed)
    push = random.uniform(-1.0, 1.0, 3)
    push *= random.uniform(5.0, 25.0) / np.linalg.norm(push)
    erratic = bool(random.random() < 0.3)
    robot = FakeRobot(seed, injected)
    safe = SafeRobot(robot, LIMITS, robot.clock)
    forces, braking = [], []
    for cycle in range(CYCLES):
        safe.read()
        late = robot.late
        force = requested(push, erratic, cycle)
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


@pytest.mark.parametrize(
    "episodes", [105, pytest.param(1000, marks=pytest.mark.slow, id="thousand")]
)
def test_lasting_fault_stops_within_20_ms(episodes: int) -> None:
    stopped = dict.fromkeys(FAULTS, 0)
    for seed in range(episodes):
        kind = FAULTS[seed % len(FAULTS)]
        start = 10 + seed % 23
        forces, braking, safe = episode(seed, (kind(start, CYCLES),))
        assert_within_limits(forces)
        assert not any(braking[:start])
        assert all(braking[start + STOP_CYCLES :]), (kind.__name__, seed, start)
        assert safe.stop is not None and safe.stop.reason is REASONS[kind]
        stopped[kind] += 1
    assert min(stopped.values()) >= episodes // len(FAULTS)


@pytest.mark.parametrize("kind", FAULTS)
def test_fault_of_one_cycle_does_not_stop(kind: Callable[[int, int], Fault]) -> None:
    for seed in range(10):
        forces, braking, safe = episode(seed, (kind(12, 13),))
        assert_within_limits(forces)
        assert safe.stop is None and not any(braking)


@pytest.mark.parametrize("episodes", [20, pytest.param(100, marks=pytest.mark.slow)])
def test_no_stop_without_fault(episodes: int) -> None:
    for seed in range(episodes):
        forces, braking, safe = episode(seed, ())
        assert_within_limits(forces)
        assert safe.stop is None and not any(braking)
        assert np.linalg.norm(forces, axis=1).max() > 2.0
