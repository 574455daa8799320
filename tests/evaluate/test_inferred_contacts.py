"""Contacts inferred from motion along runs of bodies that are wider than their model knows."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from evaluation_worlds import GluedBodies, by_model

from contactgraph.data import Dataset, InvalidInputError
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import collect, evaluate_open_loop, run_episode
from contactgraph.model import MotionNoise, load_model, shipped_model
from contactgraph.policies import MPCPolicy

WIDER = partial(PickupTask, radius=0.046)


@pytest.fixture(scope="module")
def model():
    return load_model(shipped_model("pickup")).model


@pytest.fixture(scope="module")
def trajectories() -> Dataset:
    return Dataset(tuple(collect([WIDER], [PickupExpert()], 2, 7100)))


@pytest.mark.slow
def test_motion_reveals_contacts_of_recorded_trajectories_that_distance_denies(
    model, trajectories
) -> None:
    found = evaluate_open_loop(model, trajectories, motion_noise=MotionNoise())
    # Nearly all that measured contacts gain; no more, for the rollouts themselves forget.
    gain = found["edge_f1"] - found["edge_f1_unmeasured"]
    assert gain > 0.05 and found["edge_f1_inferred"] - found["edge_f1_unmeasured"] > 0.5 * gain
    assert found["n_step_rmse_inferred_m"] != found["n_step_rmse_unmeasured_m"]
    # Contacts that were recorded have no part in it.
    bare = Dataset(tuple(replace(trajectory, contact=None) for trajectory in trajectories))
    again = evaluate_open_loop(model, bare, motion_noise=MotionNoise())
    assert again["n_step_rmse_inferred_m"] == found["n_step_rmse_inferred_m"]
    assert again["edge_f1_inferred"] is None
    unasked = evaluate_open_loop(model, trajectories)
    assert unasked["edge_f1_inferred"] is unasked["n_step_rmse_inferred_m"] is None
    assert unasked["edge_f1_unmeasured"] == found["edge_f1_unmeasured"]


@pytest.mark.slow
def test_motion_reveals_contacts_in_closed_loop_that_distance_denies(model) -> None:
    without, _ = by_model(model, WIDER, 1, 7100, measured=False, replan_every=10)
    noise = MotionNoise()
    inferred, _ = by_model(
        model, WIDER, 1, 7100, measured=False, replan_every=10, motion_noise=noise
    )
    assert without.estimated.edges.recall < 0.5 and inferred.estimated.edges.f1 > 0.95
    assert inferred.estimated.onset_delays == (0.0,)


def test_policies_receive_the_applied_control() -> None:
    applied_controls = []

    class Strong:
        def reset(self, scene, seed):
            pass

        def __call__(self, observation):
            return np.array([30.0, -1.0])

        def applied(self, control):
            applied_controls.append(control)

    trajectory = run_episode(PickupTask(), Strong(), 0)
    # The task's limit is 10 N.
    assert np.array_equal(applied_controls, trajectory.control) and np.all(
        trajectory.control == [10.0, -1.0]
    )
    assert hasattr(MPCPolicy, "applied")


def test_arguments(trajectories) -> None:
    with pytest.raises(InvalidInputError, match=r"must be a ContactDynamics.*found GluedBodies"):
        evaluate_open_loop(GluedBodies(), trajectories, motion_noise=MotionNoise())
    with pytest.raises(InvalidInputError, match=r"radius must be above 0, to 0.06 m, found 0.1"):
        PickupTask(radius=0.1)
