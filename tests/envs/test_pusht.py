"""PushT as a task: its poses, contacts, walls, and the scripted pushes."""

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import RestPolicy, pusht
from contactgraph.envs.episodes import episode_seeds, run_episode

pytest.importorskip("gym_pusht", reason="gym-pusht is missing", exc_type=ImportError)


AGENT_RADIUS, CENTRE = 0.015, np.array([0.0, 0.045])
"""m: of the agent's disc, and the block's centre of mass in its frame."""


@pytest.fixture(scope="module")
def pushes() -> list:
    """Four episodes of each policy."""
    task = pusht.PushTTask()
    made = (task.fixed_start, task.expert, task.explorer)
    return [[run_episode(task, make(), seed) for seed in episode_seeds(4, 0)] for make in made]


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "gym_pusht", None)
    with pytest.raises(InvalidInputError, match=r"pip install 'contactgraph\[pusht\]'$"):
        pusht.PushTTask()


def test_the_fixed_start_reaches_every_goal_and_the_same_seed_repeats_it(pushes: list) -> None:
    assert [each.scene.metadata["success"] for each in pushes[0]] == [True] * 4
    again = run_episode(
        pusht.PushTTask(), pusht.PushTTask.fixed_start(), int(pushes[0][1].scene.metadata["seed"])
    )
    for name in ("position", "control", "orientation", "contact"):
        np.testing.assert_array_equal(getattr(again, name), getattr(pushes[0][1], name))


def test_velocities_are_differences_of_poses(pushes: list) -> None:
    for trajectory in (each for made in pushes for each in made):
        position, velocity = trajectory.position, trajectory.velocity
        np.testing.assert_allclose(position[:-1] + 0.1 * velocity[1:], position[1:], atol=1e-12)
        turn = np.diff(trajectory.orientation, axis=0)
        np.testing.assert_allclose(0.1 * trajectory.angular_velocity[1:], turn, atol=1e-12)
        assert np.abs(turn).max() < 1.0  # an angle does not jump by a turn


def outline_distance(trajectory, step: int) -> float:
    """m from the agent's rim to the T, by the recorded poses and outlines."""
    scene = trajectory.scene
    angle = trajectory.orientation[step, 1, 0]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    local = (trajectory.position[step, 0] - trajectory.position[step, 1]) @ turn
    distances = []
    for corners in scene.polygons:
        following = np.roll(corners, -1, axis=0)
        along = following - corners
        share = np.sum((local - corners) * along, axis=1) / np.sum(along**2, axis=1)
        nearest = corners + np.clip(share, 0.0, 1.0)[:, None] * along
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
        inside = np.sum((local - corners) * normal, axis=1)
        within = np.all(inside <= 0.0) or np.all(inside >= 0.0)
        distances.append(0.0 if within else np.linalg.norm(local - nearest, axis=1).min())
    return min(distances) - AGENT_RADIUS


def test_contacts_of_a_step_are_where_the_outlines_meet_in_it(pushes: list) -> None:
    touching, free, parted = [], [], 0
    for trajectory in pushes[0] + pushes[2]:
        gap = [outline_distance(trajectory, step) for step in range(trajectory.steps + 1)]
        speed = np.linalg.norm(trajectory.velocity[:, 1], axis=1)
        for step in range(1, trajectory.steps + 1):
            touched = trajectory.contact[step, 0, 1]
            (touching if touched else free).append(
                min(gap[step - 1 :][:2]) if touched else gap[step]
            )
            parted += touched and gap[step] > 1e-4
            assert touched or speed[step] < speed[step - 1] + 1e-3  # it drives the block on
    assert len(touching) > 50 and len(free) > 50 and parted > 0
    assert max(touching) < 1e-4 and min(free) > -1e-4


def test_the_pose_is_the_environments_own_until_the_block_leaves_the_table() -> None:
    task = pusht.PushTTask()
    observation, _ = task.reset(seed=4)
    turned, over = observation["orientation"][1, 0], False
    while not over:
        observation, *_, over, cut, _ = task.step(observation["position"][1])  # through the block
        inner = task.environment.unwrapped
        centre = inner.block.local_to_world(inner.block.center_of_gravity)
        np.testing.assert_allclose(observation["position"][1], np.array(centre) / 1000)
        turn = observation["orientation"][1, 0] - inner.block.angle
        assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < 1e-9
        assert not cut
    assert observation["position"][1].min() < 0.0 and not task.success()
    assert abs(observation["orientation"][1, 0] - turned) > 0.05
    for outline, shape in zip(task.scene.polygons, inner._block_shapes, strict=True):
        corners = np.array([np.array(each) for each in shape.get_vertices()]) / 1000
        np.testing.assert_allclose(outline, corners - CENTRE)


def test_the_goal_is_the_goal_poses_centre_of_mass() -> None:
    task = pusht.PushTTask()
    observation, _ = task.reset(seed=0)
    body = task.environment.unwrapped.get_goal_pose_body(np.array([256, 256, np.pi / 4]))
    centre = body.local_to_world((0.0, 45.0))
    np.testing.assert_allclose(observation["goal"], np.array(centre) / 1000)


def test_a_rest_keeps_the_agent_where_it_is() -> None:
    trajectory = run_episode(pusht.PushTTask(), RestPolicy(), 2)
    assert np.ptp(trajectory.position, axis=0).max() < 1e-6


def test_no_scene_begins_in_contact_and_exploration_moves_the_block(pushes: list) -> None:
    task = pusht.PushTTask()
    for seed in range(40):
        observation, _ = task.reset(seed=seed)
        assert not observation["contact"].any()
    for trajectory in pushes[2]:
        assert np.ptp(trajectory.position[:, 1], axis=0).max() > 0.02


def test_gentle_and_rough_pushes_differ_in_speed(pushes: list) -> None:
    speed = [np.linalg.norm(each.velocity[:, 0], axis=1).max() for each in pushes[1]]
    assert max(speed) > 1.2 * min(speed)


def test_the_pose_task_succeeds_where_the_t_covers_its_outline_at_the_goal() -> None:
    task = pusht.PushTPoseTask()
    run = run_episode(task, RestPolicy(), 3)
    assert run.steps == task.max_steps == 300 and not task.success()
    assert run.scene.metadata["best_score"] == task.best_score() < 0.9
    task.reset(seed=3)
    block = task.environment.unwrapped.block
    block.angle, block.position = float(pusht.GOAL_ANGLE), (256.0, 256.0)
    task.step(run.position[0, 0])
    assert task.success() and task.best_score() > 0.95
