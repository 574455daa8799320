"""Delays and scores of beliefs by hand, and noisy observations."""

import dataclasses

import numpy as np
import pytest
from evaluation_worlds import DT, random_run, scene_of

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.evaluate import EstimatedContacts, estimated_contacts
from contactgraph.policies import ObservationNoise


def run_of(contact) -> Trajectory:
    """Two bodies at rest whose contact is this at every state."""
    matrix = np.zeros((len(contact), 2, 2), bool)
    matrix[:, 0, 1] = matrix[:, 1, 0] = contact
    still = np.zeros((len(contact), 2, 2))
    return Trajectory(scene_of(2), still, still, np.zeros((len(contact) - 1, 2)), matrix)


@pytest.mark.parametrize(
    ("true", "belief", "onsets", "breaks"),
    [
        ([0, 0, 1, 1, 1, 0], [0, 0, 1, 1, 1, 0], [0], [0]),
        ([0, 0, 1, 1, 1, 0], [0, 1, 1, 1, 1, 1], [0], [np.inf]),
        ([0, 0, 1, 1, 1, 0, 0], [0, 0, 0, 0, 1, 1, 0], [2 * DT], [DT]),
        ([0, 1, 0, 1, 1], [0, 0, 0, 0, 1], [np.inf, DT], [0]),
        ([1, 1, 0, 0], [0, 1, 1, 0], [], [DT]),
    ],
)
def test_delays_by_hand(true, belief, onsets, breaks) -> None:
    # The last state has no control step, hence no belief.
    found = estimated_contacts(run_of([*true, 0]), np.array(belief)[:, None] * 0.8 + 0.1)
    assert found.onset_delays == pytest.approx(onsets)
    assert found.break_delays == pytest.approx(breaks)
    counts = found.edges
    assert counts.hits == np.sum(np.logical_and(true, belief))
    assert counts.misses + counts.false_alarms == np.sum(np.not_equal(true, belief))
    assert counts.total == len(true)


@pytest.mark.parametrize(
    ("contact", "holding", "belief", "breaks", "failed"),
    [
        # A hold ends while the bodies still touch.
        ([0, 1, 1, 1, 1, 1], [0, 1, 1, 0, 0, 0], [0, 1, 1, 1, 1, 0], [2 * DT], []),
        # A touch that does not hold: never taken for a hold, for two steps, until it does hold.
        ([0, 0, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0], [], [0]),
        ([0, 0, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0], [0, 0, 1, 1, 0, 0], [], [2 * DT]),
        ([0, 0, 1, 1, 1, 1], [0, 0, 0, 0, 1, 1], [0, 0, 1, 1, 1, 1], [], [np.inf]),
    ],
)
def test_delays_of_lost_and_failed_grasps(contact, holding, belief, breaks, failed) -> None:
    held = run_of([*holding, 0]).contact
    run = dataclasses.replace(run_of([*contact, 0]), holding=held)
    found = estimated_contacts(run, np.array(belief)[:, None] * 0.8 + 0.1)
    assert found.break_delays == pytest.approx(breaks)
    assert found.failed_grasp_delays == pytest.approx(failed)
    assert (found + found).to_json()["failed_grasps"] == 2 * len(failed)
    assert found.edges.hits == np.sum(np.logical_and(holding, belief))


def test_episodes_add_up() -> None:
    quick = estimated_contacts(run_of([0, 1, 1, 1]), np.array([[0], [1], [1]]))
    late = estimated_contacts(run_of([0, 1, 1, 1, 1]), np.array([[0], [0], [0], [1]]))
    never = estimated_contacts(run_of([0, 1, 1]), np.zeros((2, 1)))
    both = (quick + late).to_json()
    assert both["onsets"] == 2 and both["breaks"] == 0
    assert both["onset_delay_ms_p95"] == pytest.approx(2e3 * DT)
    assert both["edge_recall_found"] == 3 / 5 and both["break_delay_ms_p50"] is None
    # What was never found has no delay, and hides no other.
    lost = (quick + late + never).to_json()
    assert lost["onset_delay_ms_p95"] is None and lost["onset_delay_ms_p50"] == pytest.approx(100)
    unknown = random_run(2, 4, 0)
    unknown = Trajectory(unknown.scene, unknown.position, unknown.velocity, unknown.control)
    assert estimated_contacts(unknown, np.ones((4, 1))) == EstimatedContacts()


def test_noise_has_its_deviation_and_is_reproducible() -> None:
    noise = ObservationNoise(position=0.001, velocity=0.02, seed=3)
    true = {"position": np.ones((2000, 2)), "velocity": np.zeros((2000, 2)), "goal": np.ones(2)}
    noisy = noise.observed(true, noise.begin(1))
    assert np.std(noisy["position"]) == pytest.approx(0.001, rel=0.05)
    assert np.std(noisy["velocity"]) == pytest.approx(0.02, rel=0.05)
    assert np.mean(noisy["position"]) == pytest.approx(1.0, abs=1e-4)
    assert noisy["goal"] is true["goal"] and np.all(true["position"] == 1.0)
    again, other = (noise.observed(true, noise.begin(number)) for number in (1, 2))
    assert np.array_equal(noisy["position"], again["position"])
    assert not np.array_equal(noisy["position"], other["position"])
    clear = ObservationNoise()
    assert clear.observed(true, clear.begin(0)) is true
    with pytest.raises(InvalidInputError, match="velocity must be at least 0 and finite, found -1"):
        ObservationNoise(velocity=-1)
