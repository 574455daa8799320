"""Paths and policies of the arm on a hand that is a mass of 4 kg; no simulator is needed."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs.contract import Policy
from contactgraph_franka.envs.expert import (
    FrankaExpert,
    HandPath,
    RecordingPolicy,
    free_space_excitation,
    grasps,
)
from contactgraph_franka.envs.pickup import is_success, pickup_scene, sweep_fits

START, BLOCK = np.array([0.4, -0.2, 0.3]), np.array([0.5, 0.0, 0.05])
GOAL, NEXT, LAST = np.array([0.6, 0.2, 0.3]), np.array([0.4, 0.1, 0.2]), np.array([0.5, -0.2, 0.3])


def positions(policy: Policy, seconds: float, seed: int = 3) -> np.ndarray:
    """[T, 3] m of a free mass of 4 kg beside a block at rest."""
    scene = pickup_scene(0.01, GOAL)
    policy.reset(scene, seed)
    hand, velocity, block = START.copy(), np.zeros(3), BLOCK.copy()
    observed = []
    for _ in range(round(seconds / 0.01)):
        observation = {
            "position": np.stack([hand, block]),
            "velocity": np.stack([velocity, np.zeros(3)]),
            "goal": GOAL,
        }
        velocity = velocity + policy(observation) / 4.0 * 0.01
        hand = hand + velocity * 0.01
        observed.append(hand)
    return np.stack(observed)


def test_a_path_goes_from_point_to_point_and_rests() -> None:
    path = HandPath(START)
    rest, speed = np.zeros(3), np.array([0.3, 0.0, 0.1])
    path.append(BLOCK, speed, 2.0)
    path.append(GOAL, rest, 1.0)
    assert path.duration == 3.0
    for time, place, pace in ((0.0, START, rest), (2.0, BLOCK, speed), (9.0, GOAL, rest)):
        position, velocity, acceleration = path.at(time)
        np.testing.assert_allclose(position, place, atol=1e-12)
        np.testing.assert_allclose(velocity, pace, atol=1e-12)
        np.testing.assert_allclose(acceleration, 0.0, atol=1e-12)
    # Velocity and acceleration are those of the positions.
    before, at, after = (path.at(1.2 + shift)[0] for shift in (-1e-4, 0.0, 1e-4))
    np.testing.assert_allclose((after - before) / 2e-4, path.at(1.2)[1], atol=1e-6)
    np.testing.assert_allclose((after - 2 * at + before) / 1e-8, path.at(1.2)[2], atol=1e-5)


def test_the_expert_visits_further_points_after_the_goal() -> None:
    observed = positions(FrankaExpert(noise=0.0, further=[NEXT, LAST]), 10.0)
    for point in (BLOCK, GOAL, NEXT, LAST):
        assert np.linalg.norm(observed - point, axis=1).min() < 0.02
    np.testing.assert_allclose(observed[-1], LAST, atol=5e-3)
    # Without further points it stays at the goal.
    np.testing.assert_allclose(positions(FrankaExpert(noise=0.0), 10.0)[-1], GOAL, atol=5e-3)


def test_free_space_excitation_visits_its_points_and_avoids_the_block() -> None:
    observed = positions(free_space_excitation([NEXT, LAST], noise=0.0), 6.0)
    for point in (NEXT, LAST):
        assert np.linalg.norm(observed - point, axis=1).min() < 0.01
    assert np.linalg.norm(observed - BLOCK, axis=1).min() > 0.1
    # The path is continuous, so that the hand never hurries.
    assert np.linalg.norm(np.diff(observed, axis=0), axis=1).max() / 0.01 < 0.45
    assert not np.array_equal(
        observed, positions(free_space_excitation([NEXT, LAST], noise=0.5), 6.0)
    )


def test_free_space_excitation_needs_a_point() -> None:
    with pytest.raises(InvalidInputError, match="at least one point"):
        free_space_excitation([])


def passes(policy: RecordingPolicy, seed: int) -> tuple[float, float]:
    """The least distance, m, of hand and block, and the least speed, m/s, near it."""
    observed = positions(policy, 10.0, seed)
    distance = np.linalg.norm(observed - BLOCK, axis=1)
    speed = np.linalg.norm(np.diff(observed, axis=0, prepend=START[None]), axis=1) / 0.01
    return float(distance.min()), float(speed[distance < 0.02].min(initial=np.inf))


@pytest.mark.parametrize("wanted", [True, False])
def test_free_space_excitation_avoids_the_block_and_a_grasp_reaches_it(wanted: bool) -> None:
    policy = RecordingPolicy()
    for seed in [seed for seed in range(10) if grasps(seed) is wanted]:
        nearest, _ = passes(policy, seed)
        assert (nearest < 0.03) if wanted else (nearest > 0.08)


def test_the_share_of_grasps_at_rest_is_as_configured() -> None:
    seeds = [seed for seed in range(12) if grasps(seed)]
    assert all(passes(RecordingPolicy(0.0), seed)[1] > 0.2 for seed in seeds)
    assert all(passes(RecordingPolicy(1.0), seed)[1] < 0.1 for seed in seeds)
    rest = [passes(RecordingPolicy(), seed)[1] < 0.1 for seed in seeds]
    assert 0.2 < np.mean(rest) < 0.8


HELD_AT = np.array([0.5, 0.2, 0.3])


def test_expert_and_layout_need_no_simulator() -> None:
    hidden = "import sys; sys.modules['mujoco'] = None; "
    script = hidden + "import contactgraph_franka.envs.expert, contactgraph_franka.envs.pickup"
    subprocess.run([sys.executable, "-c", script], check=True)


def test_the_expert_pushes_as_the_hand_is_heavy() -> None:
    observation = {
        "position": np.array([[0.4, -0.2, 0.2], [0.5, 0.0, 0.05]]),
        "velocity": np.zeros((2, 3)),
        "goal": HELD_AT,
    }
    scene, forces = pickup_scene(0.01, HELD_AT, block_mass=0.4), []
    assert scene.mass is not None
    for mass in (None, np.array([4.0, 0.4]), np.array([8.0, 0.4])):
        expert = FrankaExpert(noise=0.0)
        expert.reset(replace(scene, mass=mass), 0)
        forces.append(np.stack([expert(observation) for _ in range(3)])[2])
    np.testing.assert_array_equal(forces[0], forces[1])
    assert np.linalg.norm(forces[2] - forces[1]) > 0.1


def test_success_needs_the_grasped_block_at_the_goal() -> None:
    up, aside = np.array([0.0, 0.0, 0.001]), np.array([0.0, 0.001, 0.0])
    for off, both, yes in ((29, 0, True), (31, 0, False), (0, 49, True), (0, 51, False)):
        block = HELD_AT + both * aside
        assert is_success(np.stack([block + off * up, block]), HELD_AT) == yes
    with pytest.raises(InvalidInputError, match="a hand and a block"):
        is_success(HELD_AT[None], HELD_AT)


def test_a_sweep_must_end_within_the_workspace_and_the_box() -> None:
    hand = np.array([0.4, 0.0, 0.2])
    low, high = np.array([0.0, -1.0, 0.0]), np.array([2.0, 1.0, 1.0])
    near, far = np.array([0.55, 0.0, 0.05]), np.array([0.65, 0.0, 0.05])
    assert sweep_fits(hand, near, low, high) and not sweep_fits(hand, far, low, high)
    assert not sweep_fits(hand, near, low, np.array([0.7, 1.0, 1.0]))
    assert not sweep_fits(hand, near, np.array([0.38, -1.0, 0.0]), high)
