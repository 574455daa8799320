"""Rules of holding, against times and forces by hand."""

import numpy as np
import pytest

from contactgraph.envs.grip import BreakingHold, DelayedHold, HiddenSwitchHold, SwitchedHold
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.planar.world import PlanarWorld

ON_EACH_ENGINE = pytest.mark.usefixtures("engine")
DT = 0.05
SUBSTEP = 0.005


class Pair:
    """A stand-in of the world: gripper and one body, whose touch the test sets."""

    def __init__(self) -> None:
        self.touching_pairs = frozenset()
        self.joined_pairs = frozenset()
        self.switch, self.tension = 0.0, 0.0

    @property
    def holding(self) -> np.ndarray:
        return np.array([[False, bool(self.joined_pairs)], [bool(self.joined_pairs), False]])

    def touch(self, on: bool) -> None:
        self.touching_pairs = frozenset({(0, 1)} if on else ())

    def join(self, first: int, second: int) -> None:
        assert {first, second} == {0, 1} and not self.joined_pairs
        self.joined_pairs = frozenset({(0, 1)})

    def part(self, first: int, second: int) -> None:
        assert {first, second} == {0, 1} and self.joined_pairs
        self.joined_pairs = frozenset()

    def joint_tension(self, first: int, second: int) -> float:
        return self.tension


def holds_after(rule, world, substeps):
    """Whether the rule holds after each of so many substeps."""
    result = []
    for _ in range(substeps):
        rule.update(world, SUBSTEP)
        result.append(bool(world.holding[0, 1]))
    return result


def two_discs(rule, gap=0.0, velocity=(0.0, 0.0)):
    bodies = [
        PlanarBody(np.zeros(2), 1.0, radius=0.04, velocity=np.array(velocity)),
        PlanarBody(np.array([0.08 + gap, 0.0]), 1.0, radius=0.04),
    ]
    return PlanarWorld(bodies, DT, 10, rule)


def force(x):
    return np.array([[x, 0.0], [0.0, 0.0]])


def test_a_switch_holds_and_lets_go_of_what_is_touched():
    rule, world = SwitchedHold(), Pair()
    world.switch = 1.0
    assert holds_after(rule, world, 2) == [False, False]
    world.touch(True)
    assert holds_after(rule, world, 2) == [True, True]
    world.switch = 0.5
    assert holds_after(rule, world, 1) == [False]
    world.switch = 0.51
    assert holds_after(rule, world, 1) == [True]
    world.touch(False)
    assert holds_after(rule, world, 3) == [True] * 3


@ON_EACH_ENGINE
def test_switched_off_bodies_keep_their_momentum_and_part_freely():
    world = two_discs(SwitchedHold(), gap=0.01, velocity=(1.0, 0.0))
    world.switch = 1.0
    for _ in range(4):
        world.step(force(0.0))
    assert world.holding[0, 1]
    # Inelastic: half the speed for both.
    np.testing.assert_allclose(world.velocity, [[0.5, 0.0], [0.5, 0.0]], atol=1e-3)
    for _ in range(4):
        world.step(force(-2.0))
    # Pulled back together: -2 N for 0.2 s on 2 kg.
    np.testing.assert_allclose(world.velocity, [[0.3, 0.0], [0.3, 0.0]], atol=2e-3)
    world.switch = 0.0
    for _ in range(4):
        world.step(force(-2.0))
    assert not world.holding.any()
    # Half a substep more or less until the switch acts: 0.01 m/s.
    np.testing.assert_allclose(world.velocity, [[-0.1, 0.0], [0.3, 0.0]], atol=0.012)


def test_a_hidden_switch_keeps_to_its_times_and_repeats_them():
    rule, world = HiddenSwitchHold(3, on=(0.2, 0.2), off=(0.3, 0.3)), Pair()
    world.touch(True)
    first = holds_after(rule, world, 400)
    changes = np.flatnonzero(np.diff(np.array(first, dtype=int)))
    lengths = set(zip(np.diff(changes), np.array(first)[changes[1:]], strict=True))
    assert lengths == {(40, True), (60, False)}
    world.part(0, 1)
    again = HiddenSwitchHold(3, on=(0.2, 0.2), off=(0.3, 0.3))
    assert holds_after(again, world, 400) == first


def test_a_hidden_switch_draws_its_times_in_their_ranges_from_its_seed():
    runs = []
    for seed in (0, 0, 1):
        rule, world = HiddenSwitchHold(seed, (0.4, 1.4), (0.3, 1.2)), Pair()
        world.touch(True)
        runs.append(np.array(holds_after(rule, world, 6000)))
    assert np.array_equal(runs[0], runs[1]) and not np.array_equal(runs[0], runs[2])
    changes = np.flatnonzero(np.diff(runs[0].astype(int)))
    lengths, on = SUBSTEP * np.diff(changes), runs[0][changes[1:]]
    assert 0.39 < lengths[on].min() < 0.7 and 1.1 < lengths[on].max() < 1.41
    assert 0.29 < lengths[~on].min() < 0.6 and 0.9 < lengths[~on].max() < 1.21


def test_a_hold_ends_after_its_time_and_not_again_before_parting():
    rule, world = BreakingHold(0, times=(0.1, 0.1)), Pair()
    world.touch(True)
    # Joined in the first update; 0.1 s are the next 20.
    assert holds_after(rule, world, 21) == [True] * 20 + [False]
    assert holds_after(rule, world, 100) == [False] * 100
    world.touch(False)
    holds_after(rule, world, 9)
    world.touch(True)
    assert holds_after(rule, world, 20) == [False] * 20  # 45 ms are no parting
    world.touch(False)
    holds_after(rule, world, 10)
    world.touch(True)
    assert holds_after(rule, world, 1) == [True]


def test_hold_times_are_drawn_for_each_hold():
    rule, world = BreakingHold(5, times=(0.5, 2.0)), Pair()
    lengths = []
    for _ in range(40):
        world.touch(True)
        lengths.append(SUBSTEP * sum(holds_after(rule, world, 500)))
        world.touch(False)
        holds_after(rule, world, 10)
    assert 0.5 <= min(lengths) < 0.7 and 1.8 < max(lengths) <= 2.005
    assert np.mean(lengths) == pytest.approx(1.25, abs=0.2)


def test_a_hold_ends_above_its_tension():
    rule, world = BreakingHold(tension=4.0), Pair()
    world.touch(True)
    world.tension = 3.99
    assert holds_after(rule, world, 1000) == [True] * 1000
    world.tension = 4.01
    assert holds_after(rule, world, 3) == [False] * 3


@ON_EACH_ENGINE
@pytest.mark.parametrize(("pull", "holds"), [(-7.9, True), (-8.1, False), (10.0, True)])
def test_half_the_pull_on_the_gripper_is_the_tension_of_a_pair(pull, holds):
    world = two_discs(BreakingHold(tension=4.0), gap=0.001, velocity=(0.1, 0.0))
    for _ in range(3):
        world.step(force(0.0))
    assert world.holding[0, 1]
    world.step(force(pull))
    assert world.holding[0, 1] == holds
    if not holds:  # torn off within a substep: it takes no more than its impulse with it
        assert -4.0501 * SUBSTEP < world.velocity[1, 0] - 0.05 < 0.001


@ON_EACH_ENGINE
def test_a_torn_off_body_must_part_before_it_is_held_again():
    world = two_discs(BreakingHold(tension=4.0), gap=0.001, velocity=(0.1, 0.0))
    for _ in range(3):
        world.step(force(0.0))
    world.step(force(-10.0))
    for _ in range(6):  # back at once, then pressed: less than 0.05 s apart, or not at all
        world.step(force(10.0))
    assert not world.holding.any() or (0, 1) not in world.touching_pairs


def test_only_some_bodies_can_be_held():
    world = Pair()
    world.touch(True)
    assert holds_after(BreakingHold(nodes={2}), world, 5) == [False] * 5
    assert holds_after(BreakingHold(nodes={1}), world, 5) == [True] * 5


def test_a_delayed_hold_comes_after_its_time_without_interruption():
    rule, world = DelayedHold(0.4), Pair()
    world.touch(True)
    # The touch is seen in the first update; 0.4 s later is the 81st.
    assert holds_after(rule, world, 79) == [False] * 79
    world.touch(False)
    assert holds_after(rule, world, 1) == [False]
    world.touch(True)
    assert holds_after(rule, world, 82) == [False] * 80 + [True, True]
    world.touch(False)
    assert holds_after(rule, world, 10) == [True] * 10
    world.part(0, 1)
    world.touch(True)
    assert holds_after(DelayedHold(0.4), world, 81) == [False] * 80 + [True]


@ON_EACH_ENGINE
def test_the_engine_holds_a_pressed_body_after_the_delay():
    world = two_discs(DelayedHold(0.4), gap=0.0005)
    holding, touching = [], []
    for _ in range(20):
        world.step(force(1.0))
        holding.append(bool(world.holding[0, 1]))
        touching.append(bool(world.contact[0, 1]))
    first = touching.index(True)
    assert first <= 1 and holding.index(True) - first in (8, 9)
