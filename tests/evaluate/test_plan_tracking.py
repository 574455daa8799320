"""Planned against executed, on episodes whose plans are made by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
from evaluation_worlds import random_run

from contactgraph.control import PlanStatus
from contactgraph.data import pair_indices
from contactgraph.evaluate import PlanTrackingError, plan_tracking_error
from contactgraph.evaluate.baselines import constant_velocity, fixed_contact_oracle
from contactgraph.policies import EpisodeRecord

HORIZON, STEPS = 12, 10  # 0.5 s are 10 steps
RUN = random_run(3, 45, 4)


def record_of(trajectory, every, offset=0.0):
    """Plans, made every few steps, that place node 1 ``offset`` [m] off its later position."""
    step_index = np.arange(trajectory.steps)
    ahead = np.minimum(step_index[:, None] + np.arange(HORIZON + 1), trajectory.steps)
    plan = trajectory.position[ahead]
    plan[:, 1:, 1, 0] += offset
    first, second = pair_indices(trajectory.scene.node_count).T
    status = np.where(step_index % every == 0, PlanStatus.ITERATION_LIMIT, PlanStatus.PLAN_REUSED)
    # What is kept of a plan while it is followed must not count as one.
    plan[step_index % every != 0] += 7.0
    belief = np.where(trajectory.contact[ahead[:, 1:]][:, :, first, second], 0.9, 0.1)
    return EpisodeRecord(np.ones(trajectory.steps), status, plan, belief, belief[:, 0])


def test_against_a_loop_over_windows():
    record = record_of(RUN, 12, 0.03)
    belief = record.plan_belief
    belief[0, 3, 0] = 1.0 - belief[0, 3, 0]
    belief[0, STEPS:] = 0.5  # beyond the window
    found = plan_tracking_error(RUN, record)
    assert found.windows == 3  # begun at 0, 12, 24; the one of 36 ends after the run
    starts = [0, 12, 24]
    assert found.planned.rmse == pytest.approx(0.03 / np.sqrt(3))
    for baseline, value in (
        (constant_velocity, found.constant_velocity),
        (fixed_contact_oracle, found.fixed_contact),
    ):
        predicted = baseline(RUN, STEPS)
        errors = [predicted[t] - RUN.position[t + 1 : t + STEPS + 1] for t in starts]
        assert value.rmse == pytest.approx(np.sqrt(np.mean(np.sum(np.square(errors), axis=-1))))
    assert found.edges.total == 3 * STEPS * 3
    assert found.edges.accuracy == pytest.approx(1 - 1 / 90)
    true = RUN.contact[4, 0, 1]
    assert (found.edges.misses, found.edges.false_alarms) == (int(true), 1 - int(true))


def test_only_bodies_that_move_are_moving():
    position = RUN.position.copy()
    position[:, 2] = position[0, 2] + 2e-4 * np.sin(np.arange(46))[:, None]
    still = replace(RUN, position=position)
    found = plan_tracking_error(still, record_of(still, 15, 0.03))
    assert found.planned.rmse == pytest.approx(0.03 / np.sqrt(3))
    assert found.planned_moving.rmse == pytest.approx(0.03 / np.sqrt(2))


def test_a_controller_that_moves_no_object_gets_no_error():
    """The gripper moves, and all is planned well: no credit for objects that rest."""
    position = RUN.position.copy()
    position[:, 1:] = position[0, 1:]
    still = replace(RUN, position=position)
    found = plan_tracking_error(still, record_of(still, 15, 0.03))
    assert found.windows == 3 and found.moved_objects == 0
    assert found.planned.rmse == pytest.approx(0.03 / np.sqrt(3))
    values = found.to_json()
    assert values["n_step_rmse_planned_m"] is values["n_step_rmse_planned_moving_m"] is None
    assert values["planned_windows"] == 3 and values["planned_moved_objects"] == 0
    assert values["constant_velocity_planned_rmse_m"] > 0
    # One object that moves in one window of another episode is enough, and all windows count.
    pushed = position.copy()
    pushed[5:, 2, 0] += 2e-3
    pushed = replace(RUN, position=pushed)
    other = plan_tracking_error(pushed, record_of(pushed, 15, 0.03))
    assert other.moved_objects == 1
    both = found + other
    assert both.moved_objects == 1 and both.rmse == pytest.approx(0.03 / np.sqrt(3))
    assert both.to_json()["n_step_rmse_planned_m"] == both.rmse
    record = record_of(pushed, 15)
    diverged = replace(record, plan=np.full_like(record.plan, np.inf))
    values = plan_tracking_error(pushed, diverged).to_json()
    assert values["n_step_rmse_planned_moving_by_episode_m"] == ["infinite"]


@pytest.mark.parametrize("every", [1, 5, 9])
def test_plans_replaced_too_soon_do_not_count(every):
    found = plan_tracking_error(RUN, record_of(RUN, every))
    assert found.windows == 0
    values = found.to_json()
    assert values.pop("n_step_rmse_planned_moving_by_episode_m") == [None]
    assert set(values.values()) == {0, None}


def test_a_plan_that_was_not_made_for_the_moment_is_none():
    record = record_of(RUN, 10)
    assert plan_tracking_error(RUN, record).windows == 4
    record.status[10] = PlanStatus.DEADLINE_MISSED
    assert plan_tracking_error(RUN, record).windows == 3
    record.status[25] = PlanStatus.CONVERGED  # replaces the plan of 20
    assert plan_tracking_error(RUN, record).windows == 2
    short = replace(record, plan=record.plan[:, :10], plan_belief=record.plan_belief[:, :9])
    assert plan_tracking_error(RUN, short).windows == 0


def test_episodes_add_up_and_missing_values_stay_unknown():
    other = random_run(5, 30, 9)
    parts = [
        plan_tracking_error(RUN, record_of(RUN, 10, 0.01)),
        plan_tracking_error(other, record_of(other, 10)),
    ]
    both = sum(parts, PlanTrackingError())
    assert both.windows == 4 + 3 and both.edges.total == STEPS * (4 * 3 + 3 * 10)
    share = 4 * 1 / (4 * 3 + 3 * 5)  # of nodes that are 1 cm off
    assert both.planned.rmse == pytest.approx(0.01 * np.sqrt(share))
    assert both.by_episode == tuple(each.rmse_moving for each in parts)
    values = both.to_json()
    assert values["edge_f1_planned"] == values["edge_accuracy_planned"] == 1.0
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    bare = replace(RUN, contact=None)
    unknown = (both + plan_tracking_error(bare, record_of(RUN, 10))).to_json()
    assert {name for name, value in unknown.items() if value is None} == {
        "frozen_contact_planned_rmse_m",
        *(f"edge_{score}_planned" for score in ("precision", "recall", "f1", "accuracy")),
    }
    record = record_of(RUN, 10)
    record.plan[0] = np.nan
    assert plan_tracking_error(RUN, record).to_json()["n_step_rmse_planned_m"] is None
