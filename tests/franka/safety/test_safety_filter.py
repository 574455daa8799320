"""Each limit and each stop reason of the safety filter."""

from dataclasses import replace

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph_franka.safety import Command, RobotReading, SafetyFilter, SafetyLimits, StopReason
from contactgraph_franka.safety.limits import apply_virtual_walls

LIMITS = SafetyLimits()
CYCLE = 0.001
EASE_CYCLES = 17
"""From the largest force to none."""
CENTRE = (0.5, 0.0, 0.2)
PUSH = np.array([0.0, 100.0, 0.0])


def reading(cycle: int, **changes: object) -> RobotReading:
    whole = RobotReading(
        position=np.array([CENTRE, (0.6, 0.1, 0.1)]),
        velocity=np.zeros((2, 3)),
        time=np.full(2, cycle * CYCLE),
        robot_time=5.0 + cycle * CYCLE,
        tracked=np.ones(2, dtype=bool),
    )
    return replace(whole, **changes)


def command(cycle: int, force: np.ndarray = PUSH) -> Command:
    return Command(force, cycle * CYCLE)


def pushed(limits: SafetyLimits = LIMITS, cycles: int = 30) -> SafetyFilter:
    """A filter after ``cycles`` cycles of pushing, at most at the largest force."""
    safety = SafetyFilter(limits, -CYCLE)
    for cycle in range(cycles):
        safety(command(cycle), reading(cycle), cycle * CYCLE)
    assert safety.stop is None
    return safety


def test_long_force_is_shortened_in_its_direction() -> None:
    force = pushed()(command(30), reading(30), 0.030)
    np.testing.assert_allclose(force, [0.0, LIMITS.max_force, 0.0], rtol=1e-12)


def test_permitted_force_passes_unchanged() -> None:
    wanted = np.array([0.3, -0.4, 0.5])
    force = SafetyFilter(LIMITS, 0.0)(command(1, wanted), reading(1), CYCLE)
    np.testing.assert_array_equal(force, wanted)


def test_rate_limit() -> None:
    safety = SafetyFilter(LIMITS, 0.0)
    np.testing.assert_allclose(safety(command(1), reading(1), CYCLE), [0.0, 1.2, 0.0], rtol=1e-9)
    np.testing.assert_allclose(
        safety(command(2, -PUSH), reading(2), 2 * CYCLE), [0.0, 0.0, 0.0], atol=1e-9
    )


@pytest.mark.parametrize("size", [1e200, np.finfo(float).max])
def test_huge_forces_do_not_overflow(size: float) -> None:
    force = SafetyFilter(LIMITS, 0.0)(command(1, np.full(3, size)), reading(1), CYCLE)
    assert np.isfinite(force).all() and np.linalg.norm(force) <= 1.2 + 1e-9


def test_command_is_copied() -> None:
    safety = SafetyFilter(LIMITS, 0.0)
    given = command(1, np.array([0.3, 0.0, 0.0]))
    safety(given, reading(1), CYCLE)
    given.force[:] = np.nan
    np.testing.assert_array_equal(safety(None, reading(2), 2 * CYCLE), [0.3, 0.0, 0.0])


@pytest.mark.parametrize("reported", [np.full(3, np.nan), np.full(3, 1e9), np.zeros(2)])
def test_invalid_report_of_the_sent_force(reported: np.ndarray) -> None:
    safety = pushed()
    safety.sent(reported)
    force = safety(command(30), reading(30), 0.030)
    assert np.isfinite(force).all() and np.linalg.norm(force) <= LIMITS.max_force + 1e-9


def test_force_continues_from_the_sent_one() -> None:
    safety = pushed()
    safety.sent(np.zeros(3))
    np.testing.assert_allclose(safety(command(30), reading(30), 0.030), [0.0, 1.2, 0.0], rtol=1e-9)


def test_random_input_gives_finite_forces_within_limits() -> None:
    random = np.random.default_rng(0)
    odd = np.array([0.0, 1.0, -1.0, 40.0, 1e-320, 1e11, -1e200, np.inf, -np.inf, np.nan])
    safety, last = SafetyFilter(LIMITS, 0.0), np.zeros(3)
    for cycle in range(1, 2000):
        now = reading(cycle)
        shifted = now.position + 0.3 * random.standard_normal((2, 3)) * (random.random() < 0.1)
        speeds = random.standard_normal((2, 3)) * random.choice([0.1, 0.5])
        if random.random() < 0.1:
            speeds[random.integers(2), random.integers(3)] = random.choice(odd)
        now = replace(now, position=shifted, velocity=speeds)
        wanted = 30.0 * random.standard_normal(3)
        if random.random() < 0.1:
            wanted[random.integers(3)] = random.choice(odd)
        force = safety(command(cycle, wanted), now, cycle * CYCLE)
        assert np.isfinite(force).all()
        assert np.linalg.norm(force) <= LIMITS.max_force * (1.0 + 1e-9)
        assert np.linalg.norm(force - last) <= LIMITS.max_force_rate * CYCLE * (1.0 + 1e-9)
        # Once eased, no force is sent: the robot brakes, and begins again at zero.
        last = np.zeros(3) if safety.eased else force
        if safety.stop is not None and random.random() < 0.2:
            safety.reset(cycle * CYCLE)


def test_virtual_wall_force_is_bounded() -> None:
    racing = np.array([0.0, 0.9, 0.0])
    force = apply_virtual_walls(np.zeros(3), np.array([0.5, 0.36, 0.2]), racing, LIMITS)
    np.testing.assert_allclose(force, [0.0, -LIMITS.max_force, 0.0], rtol=1e-9)


def simulate(push: np.ndarray, limits: SafetyLimits) -> tuple[SafetyFilter, np.ndarray, float]:
    """A 4 kg hand pushed for three seconds: the filter, its final position and top speed."""
    safety = SafetyFilter(limits, -CYCLE)
    position, velocity, fastest = np.array(CENTRE), np.zeros(3), 0.0
    for cycle in range(3000):
        both = np.stack([position, CENTRE])
        now = reading(cycle, position=both, velocity=np.stack([velocity, np.zeros(3)]))
        velocity = velocity + safety(command(cycle, push), now, cycle * CYCLE) / 4.0 * CYCLE
        position = position + velocity * CYCLE
        fastest = max(fastest, float(np.linalg.norm(velocity)))
    return safety, position, fastest


@pytest.mark.parametrize("push", [[0, 50, 0], [-50, 0, 0], [0, 0, -50], [30, -30, 30]])
def test_virtual_walls_keep_the_hand_inside(push: list[float]) -> None:
    safety, position, _ = simulate(np.array(push, dtype=float), LIMITS)
    assert safety.stop is None
    assert np.all(position > LIMITS.workspace_low) and np.all(position < LIMITS.workspace_high)
    assert np.linalg.norm(position - CENTRE) > 0.1


def test_speed_stays_below_its_limit() -> None:
    wide = replace(LIMITS, workspace_low=(-9.0,) * 3, workspace_high=(9.0,) * 3)
    safety, _, fastest = simulate(PUSH, wide)
    assert safety.stop is None
    assert 0.8 * LIMITS.max_speed < fastest < LIMITS.max_speed


NAN = np.full((2, 3), np.nan)
FAST = np.array([[0.0, 1.1, 0.0], [0.0, 0.0, 0.0]])
FAR = np.array([CENTRE, (0.6, 0.1, 0.15)])
LONE = {"position": NAN[:1], "velocity": NAN[:1], "time": np.zeros(1), "tracked": np.ones(1)}


@pytest.mark.parametrize(
    ("reason", "changes"),
    [
        (StopReason.READING_NOT_FINITE, {"position": NAN}),
        (StopReason.READING_NOT_FINITE, {"velocity": NAN}),
        (StopReason.READING_NOT_FINITE, {"velocity": np.full((2, 3), 1e300)}),
        (StopReason.READING_NOT_FINITE, {"robot_time": np.nan}),
        (StopReason.READING_STALE, {"time": np.zeros(2)}),
        (StopReason.READING_NOT_FINITE, {"time": np.array([np.inf, 0.0])}),
        (StopReason.READING_STALE, {"time": np.full(2, 9.0)}),
        (StopReason.READING_FROZEN, {"robot_time": 5.029}),
        (StopReason.OBJECT_LOST, {"tracked": np.array([True, False])}),
        (StopReason.POSITION_JUMPED, {"position": FAR}),
        (StopReason.READING_UNFIT, LONE),
    ],
)
def test_rejected_readings(reason: StopReason, changes: dict[str, object]) -> None:
    safety = pushed()
    for cycle in range(30, 33 + EASE_CYCLES):
        force = safety(command(cycle), reading(cycle, **changes), cycle * CYCLE)
        # Eased off at once (except where a reading may still come), stopped when it lasts.
        waits = reason is StopReason.READING_FROZEN and cycle < 33
        assert (np.linalg.norm(force) > LIMITS.max_force - 1.0) == waits
        assert (safety.stop is None) == (cycle < 33)
    assert safety.stop is not None and safety.stop.reason is reason
    assert safety.eased and not force.any()


def test_missing_readings() -> None:
    safety = pushed()
    for cycle in range(30, 34):
        safety(command(cycle), None, cycle * CYCLE)
    assert safety.stop is not None and safety.stop.reason is StopReason.CONNECTION_LOST


def test_robot_slower_than_the_loop_is_not_eased_off() -> None:
    safety = pushed()
    for cycle in range(30, 60):
        force = safety(command(cycle), None if cycle % 2 else reading(cycle), cycle * CYCLE)
        assert force[1] == pytest.approx(LIMITS.max_force)
    assert safety.stop is None


def test_hand_beyond_its_largest_speed() -> None:
    safety = pushed()
    safety(command(30), reading(30, velocity=FAST), 0.030)
    assert safety.stop is not None and safety.stop.reason is StopReason.TOO_FAST


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("face", "beyond"), [(LIMITS.workspace_low, -0.001), (LIMITS.workspace_high, 0.001)]
)
def test_hand_beyond_a_face_of_its_workspace(
    axis: int, face: tuple[float, ...], beyond: float
) -> None:
    safety = pushed(replace(LIMITS, largest_jump=1.0))
    outside = reading(30).position
    outside[0, axis] = face[axis] + beyond
    safety(command(30), reading(30, position=outside), 0.030)
    assert safety.stop is not None and safety.stop.reason is StopReason.OUTSIDE_WORKSPACE


@pytest.mark.parametrize(
    "bad",
    [
        Command(np.array([0.0, np.nan, 0.0]), 0.030),
        Command(np.array([0.0, np.inf, 0.0]), 0.030),
        Command(np.zeros(2), 0.030),
        Command(np.array(["0", "0", "0"]), 0.030),
        Command(np.zeros(3), np.nan),
        Command(np.zeros(3), 0.040),
    ],
)
def test_invalid_command_stops_at_once(bad: Command) -> None:
    safety = pushed()
    assert np.isfinite(safety(bad, reading(30), 0.030)).all()
    assert safety.stop is not None and safety.stop.reason is StopReason.COMMAND_UNUSABLE


def test_late_commands() -> None:
    safety = pushed()
    for cycle in (30, 31, 32):
        force = safety(None, reading(cycle), cycle * CYCLE)
        assert safety.stop is None and force[1] == pytest.approx(LIMITS.max_force)
    safety(command(29), reading(33), 0.033)
    assert safety.stop is not None and safety.stop.reason is StopReason.COMMAND_LATE


def test_late_loop() -> None:
    safety = pushed()
    force = safety(command(34), reading(34), 0.034)
    assert safety.stop is not None and safety.stop.reason is StopReason.LOOP_LATE
    assert force[1] >= LIMITS.max_force - LIMITS.max_force_rate * LIMITS.longest_gap - 1e-9


@pytest.mark.parametrize("now", [0.0, np.nan, np.inf])
def test_broken_clock(now: float) -> None:
    safety = pushed()
    safety(command(0), reading(30), now)
    assert safety.stop is not None and safety.stop.reason is StopReason.CLOCK_BROKEN
    assert safety.eased


def test_lost_commands() -> None:
    safety = pushed()
    before = safety(command(30, -PUSH), reading(30), 0.030)
    for cycle in range(31, 35):
        force = safety(command(cycle, -PUSH), reading(cycle), cycle * CYCLE)
        # Each follows the last one that arrived.
        assert np.linalg.norm(force - before) <= LIMITS.max_force_rate * CYCLE + 1e-9
        safety.sent(None)
    assert safety.stop is not None and safety.stop.reason is StopReason.CONNECTION_LOST
    assert safety.eased


def test_only_reset_ends_a_stop() -> None:
    safety = pushed()
    safety(command(30, NAN[0]), reading(30), 0.030)
    for cycle in range(31, 100):
        force = safety(command(cycle), reading(cycle), cycle * CYCLE)
    assert safety.stop is not None and safety.stop.time == 0.030
    assert not force.any()
    safety.reset(0.099)
    assert safety(command(100), reading(100), 0.100).any() and safety.stop is None


def test_no_force_before_a_reading() -> None:
    safety = SafetyFilter(LIMITS, 0.0)
    for cycle in range(1, 20):
        assert not safety(command(cycle), None, cycle * CYCLE).any()


def test_robot_waits_for_its_first_command() -> None:
    safety = SafetyFilter(LIMITS, 0.0)
    for cycle in range(1, 20):
        assert not safety(None, reading(cycle), cycle * CYCLE).any()
    assert safety.stop is None
    assert safety(command(20), reading(20), 0.020).any()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"max_force": 0.0}, "max_force must be a positive number, found 0.0"),
        ({"largest_jump": float("nan")}, "largest_jump must be a positive number, found nan"),
        ({"workspace_low": (1.0, 0.0, 0.0)}, "workspace_low must be below workspace_high"),
        ({"workspace_low": (0.0, -1.0)}, "workspace_low must be below workspace_high"),
        ({"longest_age": 0.01}, "stop_within is 0.02 s, but longest_gap or longest_age"),
        ({"max_force": 30.0}, "stop_within is 0.02 s, but longest_gap or longest_age"),
    ],
)
def test_invalid_limits(changes: dict[str, float], text: str) -> None:
    with pytest.raises(InvalidInputError, match=text):
        replace(LIMITS, **changes)


def test_invalid_hand_index() -> None:
    with pytest.raises(InvalidInputError, match="hand must be the index of a node, found -1"):
        SafetyFilter(LIMITS, 0.0, hand=-1)
