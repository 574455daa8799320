"""The tasks in which geometry does not tell holding: contract, labels, success, experts."""

from functools import partial

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import (
    CarryExpert,
    DelayTask,
    HandlingPolicy,
    ReleaseTask,
    RestPolicy,
    StickyExpert,
    StickyTask,
    SuctionExpert,
    SuctionTask,
)
from contactgraph.envs.episodes import collect, run_episode
from contactgraph.envs.gripper_task import GRIPPER

pytestmark = pytest.mark.usefixtures("engine")

TARGET = 1
HIDDEN = partial(SuctionTask, hidden_switch=True)
TASKS = {
    "suction": (SuctionTask, SuctionExpert),
    "hidden-switch": (HIDDEN, SuctionExpert),
    "release": (ReleaseTask, CarryExpert),
    "delay": (DelayTask, CarryExpert),
    "sticky": (StickyTask, StickyExpert),
}
EVERY = pytest.mark.parametrize("name", list(TASKS))


@pytest.fixture(scope="module")
def recorded(engine):
    """Of each task, 10 episodes of the training expert and 10 of handling."""
    return {
        name: collect([task], [expert()] * 10 + [HandlingPolicy()] * 10, 20, 0)
        for name, (task, expert) in TASKS.items()
    }


def pairs_of(runs, label):
    """[all states and bodies] of the gripper's pairs."""
    return np.concatenate([getattr(run, label)[:, GRIPPER, 1:].ravel() for run in runs])


@EVERY
def test_a_seed_gives_the_same_episode_to_the_last_bit(name):
    task, expert = TASKS[name]
    for policy in (expert, HandlingPolicy):
        one, same, other = (run_episode(task(), policy(), seed) for seed in (7, 7, 8))
        for field in ("position", "velocity", "control", "contact", "holding"):
            assert np.array_equal(getattr(one, field), getattr(same, field)), field
        assert not np.array_equal(one.position, other.position)


@EVERY
def test_the_target_and_the_rule_of_a_seed_do_not_depend_on_distractors(name):
    task, expert = TASKS[name]
    alone, among = (run_episode(task(distractors=count), expert(0.0), 3) for count in (0, 3))
    count = alone.scene.node_count
    assert np.array_equal(alone.position[0], among.position[0, :count])
    start = np.flatnonzero(alone.holding.any(axis=(1, 2)))[0]
    assert np.array_equal(alone.holding[: start + 20], among.holding[: start + 20, :count, :count])


@EVERY
def test_both_labels_are_recorded_and_holding_is_contact(name, recorded):
    for run in recorded[name]:
        assert not np.any(run.holding & ~run.contact)
        # The gripper alone holds.
        assert not run.holding[:, 1:, 1:].any()


@pytest.mark.parametrize("name", TASKS)
def test_touching_without_holding_is_common(name, recorded):
    touching, holding = pairs_of(recorded[name], "contact"), pairs_of(recorded[name], "holding")
    free = np.sum(touching & ~holding) / np.sum(touching)
    assert free > (0.02 if name == "delay" else 0.3)
    assert np.sum(holding) / np.sum(touching) > 0.3


@EVERY
def test_bodies_do_not_fly_off(name, recorded):
    away = np.concatenate([np.linalg.norm(run.position, axis=-1).ravel() for run in recorded[name]])
    assert np.quantile(away, 0.9) < 3.0


@EVERY
def test_the_expert_succeeds(name):
    task, expert = TASKS[name]
    runs = collect([task], [expert(0.0)], 20, 1)
    assert sum(run.scene.metadata["success"] for run in runs) >= 17


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


@pytest.mark.parametrize(
    ("away", "speed", "switch", "success"),
    [
        (0.0195, 0.0, 0.0, True),
        (0.0205, 0.0, 0.0, False),
        (0.0, 0.019, 0.5, True),
        (0.0, 0.021, 0.0, False),
        (0.0, 0.0, 0.51, False),  # nothing is held, but the switch is on
    ],
)
def test_suction_ends_with_the_target_put_down(monkeypatch, away, speed, switch, success):
    task = SuctionTask()
    task.reset(seed=0)
    for _ in range(task.max_steps):
        assert not task.success()
        task.step(np.zeros(3))
    position, velocity = task.world.position, np.zeros((2, 2))
    position[TARGET] = task.scene.goal + np.array([0.0, away])
    velocity[TARGET] = [speed, 0.0]
    monkeypatch.setattr(type(task.world), "position", position)
    monkeypatch.setattr(type(task.world), "velocity", velocity)
    task.world.switch = switch
    assert task.success() is success
    holding = ~np.eye(2, dtype=bool)
    monkeypatch.setattr(type(task.world), "holding", holding)
    assert task.success() is False


def test_suction_that_still_holds_at_the_goal_is_no_success():
    class Keeps(SuctionExpert):
        def __call__(self, observation):
            return np.append(super().__call__(observation)[:2], 1.0)

    run = run_episode(SuctionTask(), Keeps(0.0), 0)
    assert np.linalg.norm(run.position[-1, TARGET] - run.scene.goal) < 0.02
    assert run.holding[-1, GRIPPER, TARGET] and not run.scene.metadata["success"]


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
        assert task.cost_terms().chain == (GRIPPER, min(holders))


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


def test_nothing_moves_without_a_control():
    for task, _ in TASKS.values():
        run = run_episode(task(), RestPolicy(), 0)
        assert run.control.shape[1] == task().action_space.shape[0]
        assert np.array_equal(run.position[0], run.position[-1])
        assert not run.contact.any()


def test_a_fixed_goal_is_shared_but_the_holders_are_not():
    runs = collect([partial(StickyTask, fixed_seed=4)], [RestPolicy()], 12, 0)
    assert len({tuple(run.scene.goal) for run in runs}) == 1
    assert all(np.array_equal(run.position[0, 1:], runs[0].position[0, 1:]) for run in runs)
    assert len({run.scene.metadata["holders"] for run in runs}) >= 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SuctionTask(21), "distractors must be 0 to 20, found 21"),
        (lambda: StickyTask(1), "objects must be 2 to 5, found 1"),
        (lambda: StickyTask(6), "objects must be 2 to 5, found 6"),
        (lambda: HandlingPolicy(press=1.1), "press must be 0 to 1"),
    ],
)
def test_numbers_out_of_range(make, message):
    with pytest.raises(InvalidInputError, match=message):
        make()


@pytest.mark.parametrize("policy", [SuctionExpert, CarryExpert, StickyExpert, HandlingPolicy])
def test_policies_refuse_scenes_without_a_target(policy):
    task = DelayTask()
    task.reset(seed=0)
    scene = task.scene
    alone = type(scene)(("gripper",), ("gripper",), np.array([True]), scene.dt, goal=scene.goal)
    with pytest.raises(InvalidInputError, match="needs"):
        policy().reset(alone, 0)
