"""The control loop continues under any planner fault and stops by its limits."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scripted import (
    ConstantForce,
    CycleLog,
    Delayed,
    Refusing,
    Scripted,
    StepTime,
    TimeAsForce,
    busy,
    failing,
    slow,
    unmakeable,
)

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop import ControlLoop, LoopReport, Planner, PlannerProcess, WallClock
from contactgraph_franka.safety import FakeRobot, SafeRobot, SafetyLimits, StopReason
from contactgraph_franka.safety.fake_robot import RealtimeFakeRobot
from contactgraph_franka.safety.faults import Fault, nan_fault

LIMITS = SafetyLimits()
# For tests in real time on busy machines.
PATIENT = replace(LIMITS, longest_gap=0.1, longest_age=0.1, longest_track_age=0.1, stop_within=0.2)
GOAL = np.array([0.5, 0.0, 0.3])


def stepped(
    planner: Planner,
    seconds: float,
    delay: float = 0.0,
    faults: Sequence[Fault] = (),
    asked: Callable[[], bool] = lambda: False,
    **options: float,
) -> tuple[LoopReport, CycleLog, FakeRobot]:
    """An episode in simulated time, reproducible to the last bit."""
    robot, log = FakeRobot(0, faults), CycleLog()
    clock = StepTime(robot)
    safe = SafeRobot(robot, LIMITS, clock)
    loop = ControlLoop(safe, Delayed(planner, clock, delay), clock, **options)
    return loop.run(seconds, GOAL, on_cycle=log, stop_requested=asked), log, robot


def live(
    make: Callable[[], Planner], seconds: float, longest_plan_age: float = 0.4
) -> tuple[LoopReport, FakeRobot]:
    """An episode in real time, with the planner in its process."""
    clock, robot = WallClock(), FakeRobot()
    with PlannerProcess(make) as planning:
        safe = SafeRobot(RealtimeFakeRobot(robot, clock), PATIENT, clock)
        loop = ControlLoop(safe, planning, clock, longest_plan_age=longest_plan_age)
        return loop.run(seconds, GOAL), robot


def test_episode_ends_gently_after_its_duration() -> None:
    report, log, robot = stepped(Scripted(lambda _: ConstantForce()), 0.2)
    assert report.stop.reason is StopReason.FINISHED and report.completed
    assert report.stop.time == pytest.approx(0.2)
    assert robot.stopped is report.stop and robot.braking
    assert log.force[150] == pytest.approx(1.0)
    assert np.abs(np.diff(log.force)).max() <= LIMITS.max_force_rate * 0.001 + 1e-9
    assert log.sent[-1] is None and not np.any(log.force[205:])
    assert report.rate_hz == pytest.approx(1000.0) and report.overruns == 0


def test_planner_gets_readings_and_sent_forces() -> None:
    planner = Scripted(lambda _: ConstantForce())
    stepped(planner, 0.2)
    assert planner.start is not None
    np.testing.assert_array_equal(planner.start.goal, GOAL)
    np.testing.assert_allclose([each.time for each in planner.observations], np.arange(20) * 0.01)
    # The first observation came in the first cycle, before any force was sent.
    assert not planner.observations[0].applied.any()
    applied = [each.applied for each in planner.observations[1:]]
    np.testing.assert_allclose(applied, [[1.0, 0.0, 0.0]] * 19)


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.037, 0.08])
def test_late_plan_is_evaluated_at_the_present_time(delay: float) -> None:
    _, log, _ = stepped(Scripted(lambda observation: TimeAsForce(observation.time)), 0.3, delay)
    times = np.array(log.time)
    moving = (times > delay + 0.01) & (times < 0.3)
    np.testing.assert_allclose(log.force[moving], times[moving], atol=1e-6)


@pytest.mark.parametrize(
    ("policy", "options", "over"),
    [(ConstantForce(duration=0.05), {}, 0.05), (ConstantForce(), {"longest_plan_age": 0.03}, 0.03)],
)
def test_end_of_a_plan_stops_within_20_ms(
    policy: ConstantForce, options: dict[str, float], over: float
) -> None:
    planner = Scripted(lambda observation: policy if observation.time < 0.0999 else None)
    report, log, robot = stepped(planner, 1.0, **options)
    assert report.stop.reason is StopReason.COMMAND_LATE and not report.completed
    last = 0.09 + over
    times = np.array(log.time)
    assert np.all(log.force[(times > 0.02) & (times <= last)] > 0.99)
    assert not np.any(log.force[times > last + 0.020])
    assert robot.braking and report.plans_failed > 0


def test_robot_waits_for_its_first_plan() -> None:
    report, log, _ = stepped(
        Scripted(lambda _: ConstantForce(duration=1.0)), 0.5, delay=0.3, longest_plan_age=1.0
    )
    times = np.array(log.time)
    assert not np.any(log.force[times < 0.3])
    assert log.force[310] == pytest.approx(1.0)
    assert report.plans_late == report.plans > 0


def test_invalid_reading_is_neither_used_nor_planned_from() -> None:
    planner = Scripted(lambda _: ConstantForce())
    report, log, _ = stepped(planner, 0.2, faults=[nan_fault(50, 52)])
    assert report.stop.reason is StopReason.FINISHED
    assert all(np.isfinite(each.reading.position).all() for each in planner.observations)
    assert any(each.time == pytest.approx(0.052) for each in planner.observations)
    assert log.force[50] < log.force[49]
    lasting, _, _ = stepped(planner, 0.2, faults=[nan_fault(50, 90)])
    assert lasting.stop.reason is StopReason.READING_NOT_FINITE


def test_no_first_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("contactgraph_franka.loop.control_loop._FIRST_READING_S", 0.05)
    with pytest.raises(InvalidInputError, match="the robot sends no reading to begin with"):
        stepped(Scripted(lambda _: ConstantForce()), 0.2, faults=[nan_fault(0, 10**9)])


@pytest.mark.parametrize("name", ["period", "longest_plan_age", "plan_deadline"])
def test_invalid_times(name: str) -> None:
    with pytest.raises(InvalidInputError, match=f"{name} must be positive seconds, found 0"):
        stepped(Scripted(lambda _: ConstantForce()), 0.2, **{name: 0.0})


@pytest.mark.slow
def test_slow_planner_does_not_delay_the_loop() -> None:
    report, _ = live(slow, 0.6)
    assert report.stop.reason is StopReason.FINISHED
    assert report.rate_hz > 500.0
    assert 2 <= report.plans <= 5 and report.plans_late == report.plans
    assert report.plan_ms_p50 is not None and 115.0 < report.plan_ms_p50 < 200.0
    assert 120.0 < report.oldest_plan_ms < 400.0


@pytest.mark.slow
def test_busy_planner_does_not_delay_the_loop() -> None:
    report, _ = live(busy, 0.6)
    assert report.stop.reason is StopReason.FINISHED
    assert report.rate_hz > 500.0 and report.plans > 5


@pytest.mark.slow
def test_planner_without_answer_stops_the_robot() -> None:
    report, robot = live(partial(slow, 60.0, first=5), 3.0, longest_plan_age=0.2)
    assert report.stop.reason is StopReason.COMMAND_LATE
    assert report.seconds < 2.0 and robot.braking


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ZeroDivisionError("its own fault"), "ZeroDivisionError: its own fault"),
        (SystemExit(3), "ended with exit code 3"),
    ],
)
def test_planner_error_is_raised_once_the_robot_is_at_rest(error: BaseException, said: str) -> None:
    clock, robot = WallClock(), FakeRobot()
    safe = SafeRobot(RealtimeFakeRobot(robot, clock), PATIENT, clock)
    make = partial(failing, error)
    with PlannerProcess(make) as planning, pytest.raises(RuntimeError, match=said):
        ControlLoop(safe, planning, clock).run(5.0, GOAL)
    assert safe.stop is not None and safe.stop.reason is StopReason.PLANNER_FAILED
    assert robot.braking


def test_invalid_input_of_a_planner() -> None:
    with pytest.raises(InvalidInputError, match=r"no plan leads to \[0.5, 0.0, 0.3\]"):
        live(Refusing, 1.0)
    with pytest.raises(InvalidInputError, match="there is no such model"):
        live(unmakeable, 1.0)


def test_one_process_plans_several_episodes() -> None:
    clock = WallClock()
    with PlannerProcess(busy) as planning:
        for seed in (0, 1):
            safe = SafeRobot(RealtimeFakeRobot(FakeRobot(seed), clock), PATIENT, clock)
            report = ControlLoop(safe, planning, clock).run(0.1, GOAL, seed)
            assert report.stop.reason is StopReason.FINISHED and report.plans > 0


def test_requested_stop() -> None:
    cycles, planner = itertools.count(), Scripted(lambda _: ConstantForce())
    report, _, robot = stepped(planner, 30.0, asked=lambda: next(cycles) > 100)
    assert report.stop.reason is StopReason.ASKED and report.completed
    assert report.seconds < 0.2 and robot.braking
