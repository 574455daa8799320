"""Calibration of beliefs against numbers computed by hand."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_worlds import Fades, random_run

from contactgraph.data import Dataset
from contactgraph.evaluate import belief_calibration, evaluate_open_loop
from contactgraph.evaluate.trajectory_prediction import contact_belief, predict_trajectory
from contactgraph.model import (
    PRESETS,
    ContactBelief,
    ContactSensor,
    ModelConfig,
    MotionNoise,
    NoCutoff,
    PriorEdges,
)

DT = 0.05
WINDOWS = "contactgraph.evaluate.prediction_windows"


@pytest.fixture(scope="module")
def model():
    # As in test_open_loop.py, with trajectories of the same shape: compiled once.
    return PRESETS["ours-recurrent"](ModelConfig(2, 2, DT, width=8), key=jax.random.key(0))


def test_every_number_by_hand() -> None:
    belief = np.array([[0.0, 0.04, 0.25], [0.2, 0.95, np.nan]])
    label = np.array([[False, True, False], [True, False, True]])
    found = belief_calibration(belief, label)
    assert found.reliability == [
        [2, pytest.approx(0.02), 0.5],
        [0, None, None],
        [2, pytest.approx(0.225), 0.5],
        *[[0, None, None]] * 6,
        [1, pytest.approx(0.95), 0.0],
    ]
    # Too sure of none in two bins, and of contact in the third.
    assert found.expected_error == pytest.approx((2 * 0.48 + 2 * 0.275 + 0.95) / 5)
    squares = 0.0**2 + 0.96**2 + 0.25**2 + 0.8**2 + 0.95**2
    assert found.brier_score == pytest.approx(squares / 5)
    logarithms = sum(math.log(each) for each in (1.0, 0.04, 0.75, 0.2, 0.05))
    assert found.log_score == pytest.approx(-logarithms / 5)


def test_sums_of_trajectories_add_up() -> None:
    rng = np.random.default_rng(0)
    belief, label = rng.random(40), rng.random(40) < 0.3
    together = belief_calibration(belief, label)
    parts = belief_calibration(belief[:15], label[:15]) + belief_calibration(
        belief[15:], label[15:]
    )
    for name in ("expected_error", "brier_score", "log_score"):
        assert getattr(parts, name) == pytest.approx(getattr(together, name))
    assert np.allclose(
        np.array(parts.reliability, float), np.array(together.reliability, float), equal_nan=True
    )


def test_a_certain_belief_that_is_wrong_has_a_finite_score_and_no_belief_has_none() -> None:
    assert belief_calibration(np.zeros(1), np.ones(1, bool)).log_score == pytest.approx(
        -math.log(1e-6)
    )
    none = belief_calibration(np.full(2, np.nan), np.ones(2, bool))
    assert none.expected_error is none.brier_score is none.log_score is none.reliability is None


def test_a_calibrated_forecast_has_no_error_and_a_sure_one_has_the_share_of_its_mistakes() -> None:
    label = np.arange(10) < 3
    assert belief_calibration(np.full(10, 0.3), label).expected_error == pytest.approx(0.0)
    assert belief_calibration(np.ones(10), label).expected_error == pytest.approx(0.7)


def test_one_step_ahead_and_at_the_end_of_the_window() -> None:
    """The belief after h steps without a measurement is 0.8^h, from certainty at the first state.

    In the filter it fades with every state; a rollout of three steps goes on from there.
    """
    run = random_run(2, 8, 2)
    found = evaluate_open_loop(Fades(), Dataset((run,)), horizon_s=3 * DT)
    label = run.contact[1:, 0, 1]
    faded = 0.8 ** np.arange(1, 9)
    for ending, belief, true in (("", faded, label), ("_ahead", faded[2:], label[2:])):
        by_hand = belief_calibration(belief, true)
        assert found[f"brier_score{ending}_unmeasured"] == pytest.approx(by_hand.brier_score)
        assert found[f"log_score{ending}_unmeasured"] == pytest.approx(by_hand.log_score)
        name = f"calibration_error{ending}_unmeasured"
        assert found[name] == pytest.approx(by_hand.expected_error)
        assert found[f"calibration_error{ending}_inferred"] is None
        counts = [row[0] for row in found.to_json()[f"reliability{ending}_unmeasured"]]
        assert counts == by_hand.count.tolist()
    assert found["brier_score"] != found["brier_score_unmeasured"]
    bare = evaluate_open_loop(Fades(), Dataset((replace(run, contact=None),)), horizon_s=3 * DT)
    for name in ("calibration_error", "brier_score_ahead", "log_score_unmeasured"):
        assert bare[name] is None
    assert bare.to_json()["reliability"] is None


def test_padding_does_not_count() -> None:
    runs = random_run(2, 6, 0), random_run(3, 11, 1)
    evaluated = evaluate_open_loop(Fades(), Dataset(runs), horizon_s=3 * DT)
    found = evaluated.predictions["n_step_unmeasured"]
    assert found.next_step.total == 6 + 3 * 11
    assert found.last_step.total == 4 + 3 * 9


def test_the_belief_is_of_what_the_labels_mean_and_only_within_the_cutoff(model) -> None:
    types = jnp.array([[0.5, 0.3, 0.2], [1.0, 0.0, 0.0], [1.0, 0.0, 1e-9]])
    belief = ContactBelief(types)
    touch, hold = ContactSensor(), ContactSensor(reports_touch=False)
    by_touch = contact_belief(model, belief, touch, 3)
    by_hold = contact_belief(model, belief, hold, 3)
    # The second edge is beyond the cutoff, the third is not, however improbable.
    assert np.allclose(by_touch, [0.5, np.nan, 0.0], equal_nan=True)
    assert np.allclose(by_hold, [0.2, np.nan, 1e-9], equal_nan=True)
    everywhere = replace(model, cutoff=NoCutoff())
    assert np.allclose(contact_belief(everywhere, belief, touch, 3), [0.5, 0.0, 0.0])


def test_an_edge_within_the_cutoff_only_of_the_recording_counts_as_believed_absent(model) -> None:
    """Bodies that rest near each other have velocities that let the model throw them apart."""
    run = random_run(2, 6, 0)
    position, velocity = np.zeros((7, 2, 2)), np.zeros((7, 2, 2))
    position[:, 1, 0], velocity[:, 1, 0] = 0.13, 3.0
    contact = np.broadcast_to(~np.eye(2, dtype=bool), (7, 2, 2))
    run = replace(run, position=position, velocity=velocity, contact=contact)
    evaluated = evaluate_open_loop(model, Dataset((run,)), horizon_s=3 * DT)
    found = evaluated.predictions["n_step_unmeasured"]
    assert found.last_step.reliability is not None
    assert found.last_step.reliability[0] == [4, 0.0, 1.0]


def test_sources_of_beliefs(monkeypatch) -> None:
    """Which of contacts and motion correct the beliefs of each source, without motion at work."""
    made: list[tuple[bool, bool]] = []
    noise = MotionNoise()

    def predicted(model, trajectory, starts, steps, sensor, motion_noise=None):
        made.append((bool(jnp.isfinite(trajectory.contact).any()), motion_noise is noise))
        return predict_trajectory(model, trajectory, starts, steps, sensor)

    monkeypatch.setattr(f"{WINDOWS}.predict_trajectory", predicted)
    monkeypatch.setattr("contactgraph.evaluate.open_loop.check_motion_model", lambda _: None)
    run = random_run(2, 8, 2)
    for recorded in (run, replace(run, contact=None)):
        both = evaluate_open_loop(
            Fades(), Dataset((recorded,)), horizon_s=3 * DT, motion_noise=noise
        )
        assert both["n_step_rmse_inferred_m"] is not None
    without = evaluate_open_loop(Fades(), Dataset((run,)), horizon_s=3 * DT)
    assert without["n_step_rmse_inferred_m"] is None
    nothing, motion, contacts, all_of_it = (
        (False, False),
        (False, True),
        (True, False),
        (True, True),
    )
    assert made == [nothing, motion, all_of_it, nothing, motion, nothing, contacts]


@pytest.mark.slow
def test_motion_corrects_measured_beliefs_too(model) -> None:
    """By contacts and motion; where no contacts are recorded by motion alone."""
    run = random_run(2, 6, 3)
    run = replace(run, position=0.1 * run.position)
    noise = MotionNoise()
    dataset = Dataset((run,))
    both = evaluate_open_loop(model, dataset, horizon_s=3 * DT, motion_noise=noise)
    contacts = evaluate_open_loop(model, dataset, horizon_s=3 * DT)
    assert both["brier_score"] != contacts["brier_score"]
    assert both["brier_score_unmeasured"] == contacts["brier_score_unmeasured"]
    assert both["brier_score_inferred"] not in (both["brier_score"], None)
    bare = Dataset((replace(run, contact=None),))
    motion = evaluate_open_loop(model, bare, horizon_s=3 * DT, motion_noise=noise)
    assert motion["n_step_rmse_m"] == motion["n_step_rmse_inferred_m"]
    assert motion["n_step_rmse_inferred_m"] == both["n_step_rmse_inferred_m"]
    assert motion["n_step_rmse_m"] != motion["n_step_rmse_unmeasured_m"]


@pytest.mark.slow
def test_with_the_prior_as_inference_no_correction_survives_a_step(model) -> None:
    run = random_run(2, 6, 3)
    dataset = Dataset((replace(run, position=0.1 * run.position),))
    prior = replace(model, inference=PriorEdges())
    found = evaluate_open_loop(prior, dataset, horizon_s=3 * DT, motion_noise=MotionNoise())
    for name in ("brier_score", "brier_score_ahead", "n_step_rmse"):
        unit = "_m" if name.endswith("rmse") else ""
        scores = {found[f"{name}{source}{unit}"] for source in ("", "_unmeasured", "_inferred")}
        assert len(scores) == 1 and None not in scores
    # The step just made is corrected.
    assert found["edge_precision_now"] > (found["edge_precision_now_unmeasured"] or 0.0)
