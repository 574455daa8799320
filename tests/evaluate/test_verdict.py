"""Errors over moving bodies beside baselines, edges of the step just made, and the verdict."""

from dataclasses import replace

import numpy as np
import pytest
from evaluation_worlds import DT, Fades, GluedBodies, random_run, scene_of

from contactgraph.data import Dataset, Trajectory
from contactgraph.evaluate import Verdict, evaluate_open_loop
from contactgraph.evaluate.metrics import unbeaten_baselines
from contactgraph.policies import SensorFaults


def sliding(contact: np.ndarray | None = None) -> Trajectory:
    """One body slides by 0.1 m a step, at twice the speed it reports; the other rests."""
    position = np.zeros((9, 2, 2))
    position[:, 0, 0] = 0.1 * np.arange(9)
    velocity = np.zeros((9, 2, 2))
    velocity[:, 0, 0] = 0.05 / DT
    return Trajectory(scene_of(2), position, velocity, np.zeros((8, 2)), contact)


def labels(states: list[int]) -> np.ndarray:
    """[T+1, 2, 2] contact of one pair."""
    contact = np.zeros((len(states), 2, 2), dtype=bool)
    contact[:, 0, 1] = contact[:, 1, 0] = np.array(states, bool)
    return contact


def perfect(trajectory: Trajectory, steps: int) -> np.ndarray:
    return np.stack([trajectory.position[t + 1 : t + steps + 1] for t in range(9 - steps)])


def test_errors_over_moving_bodies_by_hand():
    found = evaluate_open_loop(GluedBodies(), Dataset((sliding(),)), horizon_s=2 * DT)
    behind, left = np.sqrt((0.05**2 + 0.1**2) / 2), np.sqrt((0.1**2 + 0.2**2) / 2)
    assert found["constant_velocity_rmse_moving_m"] == pytest.approx(behind)
    assert found["standing_still_rmse_moving_m"] == pytest.approx(left)
    assert found["n_step_rmse_moving_m"] == pytest.approx(behind, rel=1e-5)
    assert found["standing_still_rmse_m"] == pytest.approx(left / np.sqrt(2))
    assert found["frozen_contact_rmse_moving_m"] is found["gnn_rmse_moving_m"] is None


def test_padding_never_moves():
    runs = Dataset((sliding(), random_run(3, 8, 0)))
    both = evaluate_open_loop(GluedBodies(), runs, horizon_s=2 * DT).recorded
    assert not both.moves[both.trajectory == 0][:, 2].any()
    assert both.moves[both.trajectory == 0][:, 0].all()


def test_a_static_body_never_moves():
    run = sliding()
    measured = replace(run, position=run.position + 0.02 * np.arange(9)[:, None, None])
    fixed = replace(measured, scene=replace(run.scene, static=np.array([False, True])))
    for each, expected in ((measured, True), (fixed, False)):
        found = evaluate_open_loop(GluedBodies(), Dataset((each,)), horizon_s=2 * DT)
        moves = found.recorded.moves
        assert moves[:, 0].all() and moves[:, 1].all() == moves[:, 1].any() == expected


def test_edges_of_the_step_just_made_by_hand():
    """The sensor is one step late, and these beliefs are what it says."""
    run = sliding(labels([1, 1, 1, 0, 0, 1, 1, 0, 0]))
    found = evaluate_open_loop(
        GluedBodies(), Dataset((run, run)), horizon_s=2 * DT, faults=SensorFaults(delay_steps=1)
    )
    # The sensor says 0 1 1 1 0 0 1 1 0; the first state ends no step.
    assert found["edge_precision_now"] == pytest.approx(3 / 5)
    assert found["edge_recall_now"] == pytest.approx(3 / 4)
    assert found["edge_f1_now"] == pytest.approx(2 / 3)
    assert found["edge_f1_now_inferred"] is None
    # Believed in the first three steps, as nothing is measured.
    fading = evaluate_open_loop(Fades(), Dataset((run,)), horizon_s=2 * DT)
    assert fading["edge_precision_now_unmeasured"] == pytest.approx(2 / 3)
    assert fading["edge_recall_now_unmeasured"] == pytest.approx(1 / 2)
    assert fading["edge_f1_now_unmeasured"] == pytest.approx(4 / 7)
    bare = evaluate_open_loop(Fades(), Dataset((sliding(),)), horizon_s=2 * DT)
    assert bare["edge_f1_now"] is bare["edge_f1_now_unmeasured"] is None


def test_a_model_without_forces_is_no_better_than_constant_velocity():
    found = evaluate_open_loop(GluedBodies(), Dataset((sliding(),)), horizon_s=2 * DT)
    assert found["verdict"] is Verdict.no_better and found.unbeaten == ("constant_velocity",)
    assert found.to_json()["verdict"] == "no better"


def test_a_fitted_baseline_counts_for_the_verdict():
    dataset = Dataset((replace(sliding(), control=np.array([[10.0, 0.0]] * 8)),))
    pushed = evaluate_open_loop(GluedBodies(), dataset, horizon_s=2 * DT)
    assert pushed["n_step_rmse_moving_m"] < pushed["constant_velocity_rmse_moving_m"]
    assert pushed["verdict"] is Verdict.better_than_all
    fitted = evaluate_open_loop(
        GluedBodies(), dataset, horizon_s=2 * DT, predictions={"gnn": perfect}
    )
    assert fitted["gnn_rmse_moving_m"] == 0.0 and fitted.unbeaten == ("gnn",)
    assert fitted["verdict"] is Verdict.better_than_constant_velocity
    assert fitted.to_json()["verdict"] == "better than constant velocity"


def test_where_nothing_moves_there_is_no_verdict():
    resting = replace(sliding(), position=np.zeros((9, 2, 2)))
    found = evaluate_open_loop(GluedBodies(), Dataset((resting,)), horizon_s=2 * DT)
    assert found["verdict"] is None and found.to_json()["verdict"] is None
    assert found["constant_velocity_rmse_moving_m"] is None


@pytest.mark.parametrize(
    ("errors", "unbeaten"),
    [
        ({"n_step": 1.0, "constant_velocity": 2.0, "gnn": None}, ()),
        ({"n_step": 1.0, "constant_velocity": 2.0, "frozen_contact": 0.1}, ()),
        ({"n_step": 1.0, "constant_velocity": 1.0005, "gnn": 3.0}, ("constant_velocity",)),
        ({"n_step": 1.0, "constant_velocity": 1.01, "gnn": 1.0}, ("gnn",)),
        ({"n_step": 2.0, "constant_velocity": 3.0, "gnn": 1.0, "least_squares": 2.5}, ("gnn",)),
        ({"n_step": np.inf, "constant_velocity": 1.0, "gnn": np.inf}, ("constant_velocity", "gnn")),
        ({"n_step": 1.0, "constant_velocity": 2.0, "gnn": np.inf}, ()),
        ({"n_step": 0.0, "constant_velocity": 0.0}, ("constant_velocity",)),
    ],
)
def test_a_tie_is_no_win(errors, unbeaten):
    assert unbeaten_baselines(errors) == unbeaten
