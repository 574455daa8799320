"""Time stamps of the arm on the reader's clock."""

import numpy as np
import pytest

from contactgraph_franka.driver.arm import ClockOffset

CYCLE = 0.001


def test_time_stamps_have_no_jitter_of_the_reader() -> None:
    clock, random, offset = ClockOffset(), np.random.default_rng(0), 100.0
    errors, now = [], 0.0
    for cycle in range(2000):
        # The read comes at any time within the cycle of the state.
        came = cycle * CYCLE + offset
        now = came + random.uniform(0.0, 0.9) * CYCLE
        errors.append(clock.changed(cycle * CYCLE, now) - came)
    assert min(errors[200:]) >= 0.0 and max(errors[200:]) < 0.05 * CYCLE


def test_slow_and_paused_arm_clocks_are_followed() -> None:
    clock = ClockOffset()
    arm_time = worst = 0.0
    for read in range(20000):
        now = read * 1e-4
        stalled = 0.5 < now < 0.52
        if read % 11 == 0 and not stalled:  # a state every 1.1 ms of the reader's clock
            arm_time += CYCLE
            worst = max(worst, abs(clock.changed(arm_time, now) - now))
        else:
            clock.unchanged(now)
    assert worst < 2e-4


@pytest.mark.parametrize("gap", [0.004, 0.05])
def test_time_stamps_after_a_pause_of_the_reader(gap: float) -> None:
    clock = ClockOffset()
    for cycle in range(100):
        clock.changed(cycle * CYCLE, cycle * CYCLE)
    late = 0.099 + gap
    assert clock.changed(0.099 + gap - 2e-4, late) == pytest.approx(late - 2e-4)
    assert clock.changed(late + 1.0, late + CYCLE) <= late + CYCLE
