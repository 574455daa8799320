"""The driver with a simulated arm behind the real protocol, in a process of its own."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("franky_sim", reason="needs pip install 'contactgraph[rehearsal]'")

from contactgraph_franka.driver.franka_robot import SILENCE, FrankaRobot
from contactgraph_franka.driver.gripper import FrankaGripper
from contactgraph_franka.loop import WallClock
from contactgraph_franka.loop.control_loop import measure_loop
from contactgraph_franka.loop.realtime import realtime_priority
from contactgraph_franka.safety import Command, SafeRobot, SafetyLimits, Stop, StopReason
from contactgraph_franka.sim.simulated_robot import RobotSimulator, SimulatedRobot

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

PACE = 2.0
"""Wall seconds to a simulated one: server, client and test share what cores there are."""
TARGET = np.array([0.45, 0.0, 0.25])
MASS = 4.0
LIMITS = replace(SafetyLimits(max_force=14.0), longest_gap=0.006, longest_age=0.006)


class MissedDeadline(Exception):
    """A busy machine missed the protocol's deadlines."""


@pytest.fixture(scope="module")
def arm(server_turn: None) -> Iterator[SimulatedRobot]:
    with RobotSimulator(pace=PACE) as running:
        yield running


@pytest.fixture(scope="module")
def robot(arm: SimulatedRobot) -> Iterator[FrankaRobot]:
    with FrankaRobot(arm.address, clock=arm.clock) as connect:
        assert connect.move_to(TARGET, speed=0.5) is None, connect.last_error
        yield connect


def stolen() -> int:
    """Hundredths of a second that the host took from this virtual machine, on all cores."""
    path = Path("/proc/stat")
    return int(path.read_text().split()[8]) if path.exists() else 0


def repeated(attempt: Callable[[], None], robot: FrankaRobot | None = None) -> None:
    """Repeats an attempt with missed deadlines up to three times; up to ten times where the host
    stopped the virtual machine meanwhile."""
    for times in range(1, 11):
        before = stolen()
        try:
            return attempt()
        except (MissedDeadline, AssertionError) as error:
            again = 3 if isinstance(error, MissedDeadline) else 1
            if times >= (10 if stolen() > before else again):
                raise
            if robot is not None:
                assert robot.recover() and robot.move_to(TARGET, speed=0.5) is None


def push(robot: FrankaRobot, force: np.ndarray, seconds: float, stop: bool = True) -> np.ndarray:
    """[K, 8]: the robot's time s, position [3] m, velocity [3] m/s of the hand, and its stamp s."""
    rows: list[list[float]] = []
    with realtime_priority():
        robot.resume()
        while not rows or rows[-1][0] < rows[0][0] + seconds:
            reading = robot.read()
            if reading is None:
                time.sleep(1e-4)
            else:
                hand = [*reading.position[0], *reading.velocity[0], reading.time[0]]
                rows.append([reading.robot_time, *hand])
                robot.send(force, 0.0)
            if robot.ended is not None:
                raise MissedDeadline(robot.last_error)
        if stop:
            robot.stop(Stop(StopReason.ASKED, 0.0))
    return np.array(rows)


def at_rest(robot: FrankaRobot, within: float) -> bool:
    """Reads until the hand rests, for ``within`` s of the robot's time."""
    began, patience = None, time.monotonic() + 10.0 * PACE
    while time.monotonic() < patience:
        reading = robot.read()
        if reading is None:
            continue
        began = reading.robot_time if began is None else began
        if np.linalg.norm(reading.velocity[0]) < 2e-3:
            return True
        if reading.robot_time - began > within:
            return False
    return False


def test_reading_agrees_with_the_ground_truth(arm: SimulatedRobot, robot: FrankaRobot) -> None:
    reading = robot.read()
    assert reading is not None and reading.contact is None
    np.testing.assert_allclose(reading.position[0], TARGET, atol=3e-3)
    np.testing.assert_allclose(
        reading.position, arm.ground_truth.newest()["position"][:1], atol=1e-5
    )
    assert abs(arm.clock() - reading.time[0]) < 0.05


def test_hand_without_force_stays(robot: FrankaRobot) -> None:
    def attempt() -> None:
        rows = push(robot, np.zeros(3), 2.0)
        assert np.linalg.norm(rows[:, 1:4] - rows[0, 1:4], axis=1).max() < 1e-3
        # Time stamps follow the robot's clock, without the reader's jitter.
        drift = (rows[:, 7] - rows[0, 7]) - (rows[:, 0] - rows[0, 0])
        assert np.abs(drift).max() < 0.1 and np.abs(np.diff(drift)).max() < 0.02

    repeated(attempt, robot)


@pytest.mark.parametrize("force", [[4.0, 0.0, 0.0], [0.0, -4.0, 0.0], [0.0, 0.0, 4.0]])
def test_hand_under_force_is_a_mass(robot: FrankaRobot, force: list[float]) -> None:
    def attempt() -> None:
        rows = push(robot, np.array(force), 0.3)
        late = rows[:, 0] > rows[0, 0] + 0.1
        found = np.polyfit(rows[late, 0], rows[late, 4:7], 1)[0]
        np.testing.assert_allclose(found, np.array(force) / MASS, atol=0.02)
        assert at_rest(robot, 1.0)

    repeated(attempt, robot)


def test_stop_brakes_at_once(arm: SimulatedRobot, robot: FrankaRobot) -> None:
    def attempt() -> None:
        rows = push(robot, np.array([0.0, 8.0, 0.0]), 0.2)
        stopped = arm.ground_truth.newest()["number"]
        assert rows[-1, 5] > 0.3
        assert robot.send(np.array([0.0, 8.0, 0.0]), 0.0) is None
        assert at_rest(robot, 1.0)
        if robot.ended is not None:
            raise MissedDeadline(robot.last_error)
        speed = arm.ground_truth.since(int(stopped))["velocity"][:, 0, 1]
        # Torques change by 1 N m a cycle at most: after 20 ms the force is gone.
        assert np.argmax(speed) <= 20
        assert speed[100] < 0.5 * speed[0]

    repeated(attempt, robot)


def test_silence_stops_the_arm(arm: SimulatedRobot, robot: FrankaRobot) -> None:
    def attempt() -> None:
        push(robot, np.array([0.0, 6.0, 0.0]), 0.1, stop=False)
        silent = arm.ground_truth.newest()
        time.sleep(PACE * (SILENCE + 0.05))
        assert robot.send(np.zeros(3), 0.0) is None
        assert robot.ended is not None and robot.ended.reason is StopReason.COMMAND_LATE
        assert "did not receive a new torque" in robot.last_error
        assert at_rest(robot, 1.0)
        moved = arm.ground_truth.newest()["position"][0] - silent["position"][0]
        assert np.linalg.norm(moved) < 0.05

    repeated(attempt, robot)
    robot.resume()
    assert robot.ended is None and robot.moving
    robot.stop(Stop(StopReason.ASKED, 0.0))


def test_move_to_turns_the_hand(arm: SimulatedRobot, robot: FrankaRobot) -> None:
    assert robot.move_to([0.5, 0.1, 0.3], yaw=0.6, speed=0.5) is None
    turn = arm.ground_truth.newest()["turn"][0]
    # Pointing down is half a turn about x; then by yaw about z. Signs do not matter.
    wanted = np.array([0.0, np.cos(0.3), np.sin(0.3), 0.0])
    assert abs(turn @ wanted) > 0.999
    np.testing.assert_allclose(arm.ground_truth.newest()["position"][0], [0.5, 0.1, 0.3], atol=3e-3)


def test_description(robot: FrankaRobot) -> None:
    lines = dict(robot.describe(LIMITS))
    assert lines["mode"] == "idle: ready to move" and lines["errors"] == "none"


def test_loop_timing(robot: FrankaRobot) -> None:
    def attempt() -> None:
        timing = measure_loop(robot, LIMITS, WallClock(PACE), 0.5)
        assert timing.report.stop.reason in (StopReason.FINISHED, StopReason.LOOP_LATE)
        assert timing.states_hz > 300.0
        assert timing.state_gap_ms_p50 == pytest.approx(1.0, abs=0.01)

    repeated(attempt, robot)


def test_contact_of_the_fingers(arm: SimulatedRobot, robot: FrankaRobot) -> None:
    place = np.array([0.45, 0.0, 0.08])
    robot.move_to(place, yaw=0.0, speed=0.5)
    ahead, still, observed = np.zeros((1, 3)), np.zeros((1, 3)), np.ones(1, bool)

    def closed_on(seconds: float) -> list[float]:
        values = []
        until = arm.clock() + seconds
        while arm.clock() < until:
            fingers.follow(ahead, still, observed)
            values.append(fingers.contact())
            time.sleep(0.01)
        return values

    with FrankaGripper(arm.address, arm.clock) as fingers:
        fingers.open()
        assert np.isnan(fingers.contact())
        arm.place_block(0, np.array([0.45, 0.0, 0.05]), 0.0)
        assert closed_on(0.8)[-1] == 1.0
        assert arm.ground_truth.newest()["fingers"].all()
        assert fingers.width == pytest.approx(0.04, abs=0.002)
        fingers.open()
        assert np.isnan(fingers.contact()) and fingers.width > 0.05
        arm.place_block(0, np.array([0.6, 0.2, 0.05]), 0.0)
        # With nothing between them, they report no contact, and open again by themselves.
        values = closed_on(0.6)
        assert 0.0 in values and 1.0 not in values


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_lost_arm_is_noticed_within_20_ms(server_turn: None, how: signal.Signals) -> None:
    """A server that dies closes its connection; one that stands still is like a cable cut."""

    def attempt() -> None:
        simulator = RobotSimulator(pace=PACE)
        with simulator as running, FrankaRobot(running.address, clock=running.clock) as robot:
            server = simulator._workers[0].process
            safe = SafeRobot(robot, LIMITS, running.clock)
            with realtime_priority():
                for _ in range(3):
                    safe.reset()
                    if held(safe, running.clock, 0.1) is None:
                        break
                os.kill(server.pid, how)
                died = running.clock()
                stop = held(safe, running.clock, 0.5)
            server.kill()
            assert stop is not None and stop.reason is StopReason.CONNECTION_LOST
            assert 0.0 < stop.time - died < 0.020

    repeated(attempt)


def held(safe: SafeRobot, clock: Callable[[], float], seconds: float) -> Stop | None:
    """Sends no force for ``seconds``, or until the robot is stopped; the stop."""
    until = clock() + seconds
    while clock() < until and safe.stop is None:
        safe.read()
        safe.send(Command(np.zeros(3), clock()))
        time.sleep(5e-4)
    return safe.stop
