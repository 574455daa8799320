"""The tasks in which geometry does not tell holding: labels, success, experts."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from contactgraph.data import Dataset, Trajectory
from contactgraph.envs import (
    CarryExpert,
    DelayTask,
    HandlingPolicy,
    LookAlikesExpert,
    LookAlikesTask,
    ReleaseTask,
    StickyExpert,
    StickyTask,
    SuctionExpert,
    SuctionTask,
)
from contactgraph.envs.carry_expert import GripperForces, unit
from contactgraph.envs.episodes import collect, run_episode
from contactgraph.envs.gripper_task import GRIPPER
from contactgraph.envs.pickup_layout import distance_to_path
from contactgraph.interchange import pull_warning, pulls

TARGET = 1
HIDDEN = partial(SuctionTask, hidden_switch=True)
TASKS = {
    "suction": (SuctionTask, SuctionExpert),
    "hidden-switch": (HIDDEN, SuctionExpert),
    "release": (ReleaseTask, CarryExpert),
    "delay": (DelayTask, CarryExpert),
    "sticky": (StickyTask, StickyExpert),
    "look-alikes": (LookAlikesTask, LookAlikesExpert),
}
EVERY = pytest.mark.parametrize("name", list(TASKS))


@pytest.fixture(scope="module")
def recorded(engine):
    """Of each task, 6 episodes of the training expert and 12 of handling."""
    return {
        name: collect([task], [expert()] * 6 + [HandlingPolicy()] * 12, 18, 0)
        for name, (task, expert) in TASKS.items()
    }


def pairs_of(runs, label):
    """[all states and bodies] of the gripper's pairs."""
    return np.concatenate([getattr(run, label)[:, GRIPPER, 1:].ravel() for run in runs])


@EVERY
def test_a_recorded_episode_repeats_to_the_last_bit(name, recorded):
    task, expert = TASKS[name]
    for run, policy in ((recorded[name][5], expert()), (recorded[name][11], HandlingPolicy())):
        again = run_episode(task(), policy, run.scene.metadata["seed"])
        for field in ("position", "velocity", "control", "contact", "holding"):
            assert np.array_equal(getattr(run, field), getattr(again, field)), field


@EVERY
@pytest.mark.usefixtures("engine")
def test_the_target_and_the_rule_of_a_seed_do_not_depend_on_distractors(name):
    task, expert = TASKS[name]
    alone, among = (run_episode(task(distractors=count), expert(0.0), 3) for count in (0, 3))
    count = alone.scene.node_count
    assert np.array_equal(alone.position[0], among.position[0, :count])
    start = np.flatnonzero(alone.holding.any(axis=(1, 2)))[0]
    assert np.array_equal(alone.holding[: start + 20], among.holding[: start + 20, :count, :count])


@EVERY
def test_the_gripper_alone_holds_and_often_touches_without_holding(name, recorded):
    runs = recorded[name]
    touching, holding = pairs_of(runs, "contact"), pairs_of(runs, "holding")
    free = np.sum(touching & ~holding) / np.sum(touching)
    # Where it holds at touch, only a pair that was torn apart touches for a moment.
    assert free > {"delay": 0.02, "look-alikes": 0.0}.get(name, 0.2)
    assert np.sum(holding) / np.sum(touching) > 0.3
    assert not any(run.holding[:, 1:, 1:].any() for run in runs)
    away = np.concatenate([np.linalg.norm(run.position, axis=-1).ravel() for run in runs])
    assert np.quantile(away, 0.9) < 3.0, "bodies do not fly off"


@EVERY
def test_the_explorer_pulls_whether_the_body_holds_or_not(name, recorded):
    handled = recorded[name][6:]
    held = np.concatenate([pulls(run) for run in handled])
    touching, holding = pairs_of(handled, "contact"), pairs_of(handled, "holding")
    assert len(held) >= 10 and held.mean() < np.sum(holding) / np.sum(touching) + 0.15
    assert pull_warning(Dataset(tuple(recorded[name]))) is None


def test_the_explorer_touches_what_it_lost_again_at_once_or_later(recorded):
    waits = []
    for run in recorded["hidden-switch"][6:]:
        change = np.diff(run.contact[:, GRIPPER, TARGET].astype(int))
        ends, begins = (np.flatnonzero(change == sign) for sign in (-1, 1))
        after = np.searchsorted(begins, ends)
        again = after < len(begins)
        waits += list((begins[after[again]] - ends[again]) * run.scene.dt)
    waits = np.array(waits)
    at_once = (waits > 0.07) & (waits < 0.8)  # not a bounce for one step
    assert np.mean(at_once) > 0.1 and np.mean(waits > 0.8) > 0.1, np.round(waits, 2)


def test_an_expert_that_pulls_only_what_it_holds_is_a_warning(recorded):
    expert = recorded["hidden-switch"][:6]
    held = np.concatenate([pulls(run) for run in expert])
    assert held.mean() > 0.95
    assert pull_warning(Dataset(tuple(expert))) == (
        f"in {held.sum()} of {len(held)} pulls at a body in contact it is held, so that the force "
        "tells what only motion should; record with --exploration 0.5"
    )
    always = [replace(run, holding=run.contact) for run in expert]
    assert len(np.concatenate([pulls(run) for run in always])) > 30
    assert pull_warning(Dataset(tuple(always))) is None, "what touches always holds: nothing hides"
    unknown = [replace(run, holding=None) for run in expert]
    assert pull_warning(Dataset(tuple(unknown))) is None


def test_a_pull_is_a_force_away_from_a_body_in_contact():
    run = collect([DelayTask], [CarryExpert()], 1, 0)[0]
    position = np.zeros((7, 2, 2))
    position[:, TARGET, 0] = 0.08
    contact = np.zeros((7, 2, 2), dtype=bool)
    contact[1:, GRIPPER, TARGET] = contact[1:, TARGET, GRIPPER] = True
    holding = contact.copy()
    holding[:5] = False
    control = np.array([[-1.0, 0.0], [-1, 0], [-1, 0], [0.6, 0], [-0.4, 3], [-0.6, 0]])
    made = Trajectory(
        run.scene, position, np.zeros((7, 2, 2)), control, contact=contact, holding=holding
    )
    assert pulls(made).tolist() == [False, True]


@EVERY
@pytest.mark.usefixtures("engine")
def test_the_expert_succeeds(name):
    task, expert = TASKS[name]
    runs = collect([task], [expert(0.0)], 10, 1)
    assert sum(run.scene.metadata["success"] for run in runs) >= 9


def test_the_switch_is_a_control_of_its_own():
    task = SuctionTask(2)
    assert task.action_space.low.tolist() == [-10.0, -10.0, 0.0]
    assert task.action_space.high.tolist() == [10.0, 10.0, 1.0]
    task.reset(seed=0)
    assert task.scene.control_kind == ("force", "force", "switch")
    assert task.scene.control_of.tolist() == [[True] * 3] + [[False] * 3] * 3
    free, switched = (drive(SuctionTask(), [3.0, -2.0, on], 5) for on in (0.0, 1.0))
    assert np.array_equal(free["position"], switched["position"])
    assert free["velocity"][GRIPPER] == pytest.approx([0.75, -0.5], abs=1e-4)


def test_a_hidden_switch_leaves_the_force_alone():
    task = HIDDEN()
    assert task.action_space.shape == (2,)
    task.reset(seed=0)
    assert task.scene.control_kind is None and task.scene.metadata["hidden_switch"] is True


def drive(task, control, steps):
    observation, _ = task.reset(seed=0)
    for _ in range(steps):
        observation, *_ = task.step(np.array(control))
    return observation


def test_suction_ends_with_the_target_put_down(monkeypatch):
    task = SuctionTask()
    task.reset(seed=0)
    for _ in range(task.max_steps):
        assert not task.success()
        task.step(np.zeros(3))
    position, velocity = task.world.position, np.zeros((2, 2))
    monkeypatch.setattr(type(task.world), "position", position)
    monkeypatch.setattr(type(task.world), "velocity", velocity)
    for away, speed, switch, held, success in [
        (0.0195, 0.0, 0.0, False, True),
        (0.0205, 0.0, 0.0, False, False),
        (0.0, 0.019, 0.5, False, True),
        (0.0, 0.021, 0.0, False, False),
        (0.0, 0.0, 0.51, False, False),  # nothing is held, but the switch is on
        (0.0, 0.0, 0.0, True, False),
    ]:
        position[TARGET] = task.scene.goal + np.array([0.0, away])
        velocity[TARGET] = [speed, 0.0]
        monkeypatch.setattr(type(task.world), "holding", np.full((2, 2), held))
        task.world.switch = switch
        assert task.success() is success, (away, speed, switch, held)


@pytest.mark.parametrize("name", ["hidden-switch", "release", "delay"])
def test_the_target_must_end_within_a_decimetre_of_the_goal(name):
    task = TASKS[name][0]()
    task.reset(seed=0)
    position, contact = task.world.position, np.zeros((2, 2))
    for away, success in [(0.0999, True), (0.1001, False)]:
        position[TARGET] = task.scene.goal + np.array([away, 0.0])
        assert task.solved(task.scene, position, contact) is success


def test_a_sticky_body_at_the_goal_counts_and_another_does_not():
    task = StickyTask(5, distractors=4)
    for seed in range(5):
        task.reset(seed=seed)
        holders = {int(node) for node in task.scene.metadata["holders"].split()}
        assert 0 < len(holders & set(range(1, 6))) < 5
        contact = np.zeros((10, 10))
        for node in range(1, 10):
            position = np.full((10, 2), 9.0)
            position[node] = task.scene.goal
            assert task.solved(task.scene, position, contact) is (node in holders)
        terms = task.cost_terms()
        assert (terms.chain, terms.candidates) == ((GRIPPER, 1), (1, 2, 3, 4, 5)), "no holder told"


def test_only_the_drawn_bodies_hold_and_they_are_drawn_anew(recorded):
    drawn = set()
    for run in recorded["sticky"]:
        holders = {int(node) for node in run.scene.metadata["holders"].split()}
        drawn.add(frozenset(holders))
        held = set(np.flatnonzero(run.holding[:, GRIPPER].any(axis=0)).tolist())
        assert held <= holders
        assert len(set(run.scene.node_type[1:])) == 1
    assert len(drawn) >= 3
    touched = [run.contact[:, GRIPPER].any(axis=0).sum() for run in recorded["sticky"]]
    assert max(touched) >= 2


def test_holds_of_release_last_for_half_a_second_to_two(recorded):
    lengths = []
    for run in recorded["release"]:
        held = np.concatenate([[False], run.holding[:, GRIPPER, TARGET], [False]])
        edges = np.flatnonzero(np.diff(held.astype(int)))
        lengths += (run.scene.dt * (edges[1::2] - edges[::2])).tolist()
    assert max(lengths) <= 2.05
    # Others were torn off by pulls above 8 N, or by the end of the episode.
    assert np.mean(np.array(lengths) >= 0.5) > 0.5


def test_holds_of_delay_follow_eight_steps_of_touching(recorded):
    for run in recorded["delay"]:
        held = run.holding[:, GRIPPER, TARGET]
        if held.any():
            first = int(held.argmax())
            assert first >= 8 and run.contact[first - 8 : first, GRIPPER, TARGET].all()
            assert held[first:].all()


def test_the_switch_is_recorded_on_and_off_while_touching(recorded):
    touching = np.concatenate([run.contact[:-1, 0, 1] for run in recorded["suction"]])
    switch = np.concatenate([run.control[:, 2] for run in recorded["suction"]])
    assert set(np.unique(switch)) == {0.0, 1.0}
    assert 0.25 < np.mean(switch[touching]) < 0.85


def test_a_fixed_goal_is_shared_but_the_holders_are_not():
    task, scenes = StickyTask(fixed_seed=4), []
    for seed in range(12):
        observation, _ = task.reset(seed=seed)
        scenes.append((task.scene, observation["position"][1:]))
    first, targets = scenes[0]
    for scene, position in scenes:
        assert np.array_equal(scene.goal, first.goal) and np.array_equal(position, targets)
    assert len({scene.metadata["holders"] for scene, _ in scenes}) >= 2


def test_one_of_two_look_alikes_is_welded_and_only_its_rest_tells(recorded):
    free = [run.scene.metadata["free"] for run in recorded["look-alikes"]]
    assert set(free) == {1, 2}
    for run in recorded["look-alikes"]:
        scene, welded = run.scene, 3 - run.scene.metadata["free"]
        assert (run.position[:, welded] == run.position[0, welded]).all()
        assert scene.node_type[1] == scene.node_type[2] and not scene.static.any()
    moved = [
        run.position[-1, free] - run.position[0, free]
        for run, free in zip(recorded["look-alikes"], free, strict=True)
    ]
    assert np.median(np.linalg.norm(moved, axis=-1)) > 0.1
    tried = [
        run
        for run in recorded["look-alikes"][:6]
        if run.holding[:, GRIPPER, 3 - run.scene.metadata["free"]].any()
    ]
    assert 0 < len(tried) < 6, "the expert does not know which one is welded"


def test_the_free_look_alike_must_end_in_contact_at_the_goal(monkeypatch):
    task = LookAlikesTask()
    assert (task.reset(seed=0), task.cost_terms().candidates)[1] == (1, 2)
    free = task.scene.metadata["free"]
    for _ in range(task.max_steps):
        assert not task.success()
        task.step(np.zeros(2))
    position, contact = task.world.position, np.zeros((3, 3), dtype=bool)
    monkeypatch.setattr(type(task.world), "position", position)
    for node, away, held, success in [
        (free, 0.0999, True, True),
        (free, 0.1001, True, False),
        (free, 0.0, False, False),
        (3 - free, 0.0, True, False),
    ]:
        position[:] = 9.0
        position[node] = task.scene.goal + np.array([0.0, away])
        contact[GRIPPER, node] = held
        monkeypatch.setattr(type(task.world), "contact", contact.copy())
        assert task.success() is success, (node, away, held)
        contact[:] = False


@pytest.mark.parametrize("fixed", [None, 3])
def test_neither_look_alike_stands_in_the_way_of_the_other(fixed):
    task = LookAlikesTask(fixed_seed=fixed)
    for seed in range(20):
        observation, _ = task.reset(seed=seed)
        gripper, *both = observation["position"]
        for one, other in (both, both[::-1]):
            for end in (gripper, observation["goal"]):
                assert distance_to_path(other, one, end, 0.0) >= 0.2 - 1e-9


def test_the_pull_that_ends_a_hold_of_a_welded_body_is_above_6_newtons():
    task = LookAlikesTask()
    observation, _ = task.reset(seed=0)
    welded = 3 - task.scene.metadata["free"]
    while not observation["holding"][GRIPPER, welded]:
        hand = GripperForces(observation, welded)
        observation, *_ = task.step(hand.approach())
    away = -unit(observation["position"][welded] - observation["position"][GRIPPER])
    for force, holds in ((6.0, True), (8.5, False)):
        for _ in range(10):
            observation, *_ = task.step(force * away)
        assert bool(observation["holding"][GRIPPER, welded]) is holds
