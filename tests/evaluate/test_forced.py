from dataclasses import replace

import numpy as np
import pytest
from evaluation_worlds import DT, Fades, GluedBodies, random_run

from contactgraph.data import Dataset, InvalidInputError
from contactgraph.envs import (
    BilliardsTask,
    CarryExpert,
    DoorExpert,
    DoorTask,
    PickupExpert,
    PickupTask,
    ReleaseTask,
    RestPolicy,
    StickyExpert,
    StickyTask,
    SuctionExpert,
    SuctionTask,
)
from contactgraph.evaluate import evaluate_open_loop, forced_windows, run_episode
from contactgraph.evaluate.forced import branches
from contactgraph.evaluate.statistics import moving_errors

STEPS = 10


@pytest.mark.parametrize(
    ("task", "expert"),
    [
        (SuctionTask(hidden_switch=True), SuctionExpert()),
        (SuctionTask(distractors=1), SuctionExpert()),
        (ReleaseTask(), CarryExpert()),
        (StickyTask(), StickyExpert()),
        (DoorTask(), DoorExpert()),
        (PickupTask(engine="pymunk"), PickupExpert()),
    ],
)
def test_a_branch_under_the_recorded_controls_is_the_recording(task, expert):
    recorded, names = run_episode(task, expert, 3), ("position", "velocity", "contact")
    starts = []
    for branch in branches(task, recorded, STEPS, 0, every=50):
        starts.append(branch.start)
        for state in range(branch.start, branch.start + STEPS):
            found, *_ = branch.task.step(recorded.control[state])
            for name in names:
                assert np.array_equal(found[name], getattr(recorded, name)[state + 1])
    assert starts == list(range(0, recorded.steps - STEPS + 1, 50))


def test_a_forced_window_follows_the_recording_and_its_control():
    task, seeds = SuctionTask(engine="box2d"), (3, 4)
    recorded = Dataset(tuple(run_episode(task, SuctionExpert(), seed) for seed in seeds))
    windows, episode = forced_windows(recorded, lambda _: task, STEPS, every=60)
    assert episode == (0,) * 4 + (1,) * 4
    controls = []
    for index, each in enumerate(windows):
        start, own = 60 * (index % 4), recorded.trajectories[index // 4]
        assert each.steps == start + STEPS
        for name in ("position", "velocity", "contact", "holding"):
            assert np.array_equal(getattr(each, name)[: start + 1], getattr(own, name)[: start + 1])
        assert np.array_equal(each.control[:start], own.control[:start])
        assert np.all(each.control[start:] == each.control[start])
        controls.append(each.control[start])
        assert not np.array_equal(each.position[-1], own.position[start + STEPS])
    force, switched = np.split(np.array(controls), [2], axis=1)
    assert np.all((np.hypot(*force.T) >= 0.5) & (np.hypot(*force.T) <= 3.0))
    assert set(switched.ravel().tolist()) == {0.0, 1.0}
    again, _ = forced_windows(recorded, lambda _: task, STEPS, every=60)
    assert all(
        np.array_equal(one.position, other.position)
        for one, other in zip(windows, again, strict=True)
    )


def test_a_replay_that_differs_and_a_control_that_is_no_force():
    task = PickupTask()
    recorded = run_episode(task, PickupExpert(), 3)
    moved = replace(recorded, control=recorded.control + 0.01)
    with pytest.raises(InvalidInputError, match=r"seed 3 differs .*: position in state \d+ of 200"):
        forced_windows(Dataset((moved,)), lambda _: task, STEPS)
    table = BilliardsTask(passive=True)
    passive = Dataset((run_episode(table, RestPolicy(), 3),))
    with pytest.raises(InvalidInputError, match="controls that are forces, found nothing"):
        forced_windows(passive, lambda _: table, STEPS)


@pytest.mark.parametrize("model", [GluedBodies(), Fades()])
def test_the_last_windows_of_beginnings_are_the_windows_of_the_whole(model):
    """Forced by the recorded controls, windows are the recorded ones."""
    whole = random_run(3, 8, 0)

    def beginning(steps):
        names = ("position", "velocity", "contact")
        states = {name: getattr(whole, name)[: steps + 1] for name in names}
        return replace(whole, control=whole.control[:steps], **states)

    every = evaluate_open_loop(model, Dataset((whole,)), horizon_s=3 * DT)
    ends = Dataset(tuple(beginning(steps) for steps in range(3, 9)))
    found = evaluate_open_loop(model, ends, horizon_s=3 * DT, last_window_of=[0] * 6)
    assert found["runs"] == 1 and found["windows"] == every["windows"] == 6
    assert found.recorded.start.tolist() == every.recorded.start.tolist()
    for name in ("squared_error", "edge_active"):
        pair = (getattr(each.predictions["n_step"], name) for each in (found, every))
        np.testing.assert_allclose(*pair, rtol=1e-5, atol=1e-9)
    same = (*(name for name in found.numbers if "rmse" in name), "calibration_error_ahead")
    known = {name: every[name] for name in same if isinstance(every[name], float)}
    assert {name: found[name] for name in known} == pytest.approx(known, rel=1e-5)
    # Of the steps in the windows, of which the whole has 8.
    assert found.predictions["n_step"].next_step.total == 6 * 3 * 3
    assert every.predictions["n_step"].next_step.total == 8 * 3
    by_run = "n_step_rmse_moving_by_run_m"
    assert found[by_run] == pytest.approx(every[by_run])


def test_statistics_of_windows_by_hand():
    # Two episodes of two windows each; nothing moves in the last.
    squared, bodies = np.array([1.0, 18.0, 8.0, 0.0]), np.array([1, 2, 2, 0])
    found = moving_errors(squared, bodies, np.array([0, 0, 1, 1]))
    assert found["rmse"] == pytest.approx(np.sqrt(27.0 / 5.0))
    assert found["mean"] == pytest.approx((1.0 + 3.0 + 2.0) / 3.0)
    # Both draws of one episode are among four equally likely ones.
    assert found["rmse_interval"] == pytest.approx([2.0, np.sqrt(19.0 / 3.0)])
    assert found["mean_interval"] == pytest.approx([2.0, 2.0])


def test_the_interval_of_many_windows_is_that_of_their_mean():
    errors = np.random.default_rng(0).uniform(0.0, 1.0, 400)
    found = moving_errors(errors**2, np.ones(400, int), np.arange(400))
    half = 1.96 * errors.std() / np.sqrt(400)
    low, high = found["mean_interval"]
    assert [low, high] == pytest.approx([errors.mean() - half, errors.mean() + half], abs=0.004)


def test_errors_that_are_not_known_have_no_interval():
    still = moving_errors(np.zeros(2), np.zeros(2, int), np.arange(2))
    assert still == {}
    infinite = moving_errors(np.array([np.inf, 1.0]), np.ones(2, int), np.arange(2))
    assert infinite["mean"] is None and infinite["rmse_interval"] == [1.0, None]
