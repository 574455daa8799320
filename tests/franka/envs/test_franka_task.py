"""The arm's pickup as a task: its contract, its scenes, and reproducibility by the seed."""

import hashlib
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import check_task
from contactgraph.envs.episodes import run_episode
from contactgraph_franka.envs.expert import FrankaExpert
from contactgraph_franka.envs.franka_task import FrankaTask
from contactgraph_franka.envs.pickup import (
    CLEARANCE,
    CORRIDOR,
    HIGH,
    LOW,
    RUN_UP,
    START_HEIGHT,
)

SEEDS = range(15)
FINGERPRINT = """
import hashlib
from contactgraph_franka.envs.expert import FrankaExpert
from contactgraph_franka.envs.franka_task import FrankaTask
from contactgraph.envs.episodes import run_episode
run = run_episode(FrankaTask(1), FrankaExpert(), 5)
print(hashlib.sha256(run.position.tobytes() + run.velocity.tobytes()).hexdigest())
"""


def fingerprint(run):
    return hashlib.sha256(run.position.tobytes() + run.velocity.tobytes()).hexdigest()


@pytest.mark.slow
def test_the_contract_is_kept():
    check_task(lambda: FrankaTask(1))


@pytest.mark.slow
def test_a_seed_is_the_same_trajectory_later_in_another_process_and_beside_another_thread():
    tasks = FrankaTask(1), FrankaTask(1)
    with ThreadPoolExecutor(2) as threads:
        runs = threads.map(lambda task, s: run_episode(task, FrankaExpert(), s), tasks, (5, 6))
        here, different = map(fingerprint, runs)
    other = subprocess.run(
        [sys.executable, "-c", FINGERPRINT], capture_output=True, text=True, check=True
    )
    assert other.stdout.strip() == here != different
    # A task carries nothing from one episode into the next.
    assert fingerprint(run_episode(tasks[1], FrankaExpert(), 5)) == here


def test_nothing_begins_inside_anything_else():
    distractors = 5
    task = FrankaTask(distractors)
    for seed in SEEDS:
        task.reset(seed=seed)
        model, data = task.world.model, task.world.data
        assert all(contact.dist > -1e-6 for contact in data.contact)
        # Links collide with nothing, but they should not begin in a block either.
        blocks = [model.geom(f"block{index}").id for index in range(1 + distractors)]
        arm = [g for g in range(model.ngeom) if model.geom_bodyid[g] > 1 and g < min(blocks)]
        for part in arm:
            for block in blocks:
                assert mujoco.mj_geomDistance(model, data, part, block, 0.1, None) > 1e-3


@pytest.mark.parametrize("fixed_seed", [None, 3])
def test_scenes_are_as_the_layout_promises(fixed_seed):
    for seed in SEEDS:
        task = FrankaTask(5, fixed_seed=fixed_seed)
        observation, _ = task.reset(seed=seed)
        position, goal = observation["position"], observation["goal"]
        hand, blocks = position[0], position[1:]
        for place in (hand, goal):
            assert np.all((place >= LOW - 1e-4) & (place <= HIGH + 1e-4))
            assert place[2] >= START_HEIGHT - 1e-4
        assert np.all((blocks[:, :2] >= LOW[:2]) & (blocks[:, :2] <= HIGH[:2]))
        np.testing.assert_allclose(blocks[:, 2], 0.05, atol=1e-9)
        assert not observation["velocity"].any() and not observation["contact"].any()
        assert np.linalg.norm((blocks[0] - hand)[:2]) >= RUN_UP - 1e-4
        assert np.linalg.norm((goal - blocks[0])[:2]) >= RUN_UP - 1e-9
        for index, other in enumerate(blocks[1:, :2]):
            apart = np.linalg.norm(other - np.delete(blocks, 1 + index, axis=0)[:, :2], axis=-1)
            assert apart.min() >= CLEARANCE - 1e-9
            for start, end in ((hand, blocks[0]), (blocks[0], goal)):
                way = start[:2] + np.linspace(0.0, 1.0, 200)[:, None] * (end - start)[:2]
                assert np.linalg.norm(other - way, axis=-1).min() >= CORRIDOR - 1e-3


def test_the_fingers_are_across_the_path_to_a_block_that_faces_them():
    task = FrankaTask()
    for seed in SEEDS:
        observation, _ = task.reset(seed=seed)
        data = task.world.data
        way = observation["position"][1] - observation["position"][0]
        fingers = data.body("left_finger").xpos - data.body("right_finger").xpos
        assert fingers @ way == pytest.approx(0.0, abs=1e-5)
        facing = data.body("block0").xmat.reshape(3, 3)[:, 1]
        assert abs(fingers @ facing) == pytest.approx(np.linalg.norm(fingers), rel=1e-5)


def test_a_block_left_alone_rests():
    task = FrankaTask(3)
    first, _ = task.reset(seed=1)
    for _ in range(100):
        observation, *_ = task.step(np.zeros(3))
    np.testing.assert_allclose(observation["position"], first["position"], atol=2e-4)
    np.testing.assert_allclose(observation["velocity"], 0.0, atol=2e-3)
    assert not observation["contact"].any()


def test_the_scene_describes_its_nodes():
    task = FrankaTask(1)
    task.reset(seed=5)
    scene = task.scene
    assert scene.node_name == ("hand", "block", "distractor-0")
    assert scene.actuated.tolist() == [True, False, False]
    assert scene.mass.tolist() == [4.0, 0.4, 0.4]
    assert np.isnan(scene.size[0]).all() and scene.size[1:].tolist() == [[0.04, 0.04, 0.1]] * 2


def test_the_links_end_at_the_hand_and_begin_at_the_base():
    task = FrankaTask()
    observation, _ = task.reset(seed=2)
    links = task.link_positions()
    np.testing.assert_array_equal(links[0], [0.0, 0.0, 0.0])
    np.testing.assert_array_equal(links[-1], observation["position"][0])
    lengths = np.linalg.norm(np.diff(links, axis=0), axis=-1)
    arm = [0.333, 0.0, 0.316, 0.0825, np.hypot(0.0825, 0.384), 0.0, 0.088, 0.107, 0.1254]
    np.testing.assert_allclose(lengths, arm, atol=1e-9)


def test_the_control_is_clipped_to_20_newton():
    hard, bounded = FrankaTask(), FrankaTask()
    hard.reset(seed=0)
    bounded.reset(seed=0)
    for _ in range(5):
        one, *_ = hard.step(np.array([1e6, -25.0, 0.0]))
        other, *_ = bounded.step(np.array([20.0, -20.0, 0.0]))
    assert np.array_equal(one["position"], other["position"])
    assert one["velocity"][0] == pytest.approx([0.25, -0.25, 0.0], abs=5e-3)


def test_feedback_receives_the_state_of_every_millisecond():
    calls, task, plain = [], FrankaTask(), FrankaTask()
    for each in (task, plain):
        each.reset(seed=0)

    def feedback(part, position, velocity):
        calls.append((part, position[0].copy(), velocity[0].copy()))
        return np.array([40.0 if part < 0.5 else 0.0, -3.0, 0.0])

    observation, *_, info = task.step_under(feedback)
    parts, positions, velocities = (np.array(column) for column in zip(*calls, strict=True))
    np.testing.assert_allclose(parts, np.arange(10) / 10)
    np.testing.assert_allclose(info["control"], [10.0, -3.0, 0.0])
    np.testing.assert_allclose(np.diff(velocities[:6, 0]), 20.0 / 4.0 * 1e-3, rtol=0.02)
    np.testing.assert_allclose(np.diff(positions, axis=0), velocities[1:] * 1e-3, atol=1e-6)
    assert observation["velocity"][0, 0] == pytest.approx(0.005 * 20.0 / 4.0, rel=0.02)

    force = np.array([1.0, 2.0, 3.0])
    same, *_ = task.step_under(lambda part, position, velocity: force)
    plain.step_under(feedback)
    step, *_ = plain.step(force)
    assert all(np.array_equal(same[name], step[name]) for name in step)


def test_success_is_the_block_grasped_at_the_goal():
    task = FrankaTask()
    task.reset(seed=0)
    scene, held = task.scene, np.array([[False, True], [True, False]])
    aside = np.array([0.0, 1.0, 0.0])
    near, far = (np.stack([scene.goal, scene.goal + d * aside]) for d in (0.0499, 0.0501))
    assert task.solved(scene, near, held)
    assert not task.solved(scene, near, ~held)
    assert not task.solved(scene, far, held)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"distractors": -1}, "distractors must be 0 to 5, found -1"),
        ({"distractors": 6}, "distractors must be 0 to 5, found 6"),
        ({"render_mode": "x"}, "render_mode must be rgb_array or None, found 'x'"),
    ],
)
def test_impossible_options(options, said):
    with pytest.raises(InvalidInputError, match=said):
        FrankaTask(**options)
