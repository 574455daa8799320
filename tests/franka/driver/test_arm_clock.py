"""Stamps on the reader's clock: as sure as looks allow, and without their jitter."""

import numpy as np
import pytest

from contactgraph_franka.driver.arm import ClockOffset

TICK = 0.001


def test_stamps_have_no_jitter_of_who_reads() -> None:
    clock, random, offset = ClockOffset(), np.random.default_rng(0), 100.0
    errors, now = [], 0.0
    for tick in range(2000):
        # Looks at any time within the tick in which the state came.
        came = tick * TICK + offset
        now = came + random.uniform(0.0, 0.9) * TICK
        errors.append(clock.changed(tick * TICK, now) - came)
    assert min(errors[200:]) >= 0.0 and max(errors[200:]) < 0.05 * TICK


def test_an_arm_whose_clock_is_slow_or_stands_still_is_followed() -> None:
    clock = ClockOffset()
    arm_time = worst = 0.0
    for look in range(20000):
        now = look * 1e-4
        stalled = 0.5 < now < 0.52
        if look % 11 == 0 and not stalled:  # a state each 1.1 ms of ours
            arm_time += TICK
            worst = max(worst, abs(clock.changed(arm_time, now) - now))
        else:
            clock.unchanged(now)
    assert worst < 2e-4


@pytest.mark.parametrize("gap", [0.004, 0.05])
def test_a_reader_that_was_away_stamps_no_later_than_it_looks(gap: float) -> None:
    clock = ClockOffset()
    for tick in range(100):
        clock.changed(tick * TICK, tick * TICK)
    late = 0.099 + gap
    assert clock.changed(0.099 + gap - 2e-4, late) == pytest.approx(late - 2e-4)
    assert clock.changed(late + 1.0, late + TICK) <= late + TICK
