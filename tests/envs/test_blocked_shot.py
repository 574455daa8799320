"""The blocked shot: pillars in the direct way, and a clear way off some wall."""

import numpy as np

from contactgraph.envs import BankShotPolicy, BlockedShotTask, check_task
from contactgraph.envs.billiards import CUE, GROUND_FRICTION, RESTITUTION, TABLE, TARGET
from contactgraph.envs.blocked_shot import bank_way, clearance, images, possible
from contactgraph.envs.planar_body import PlanarBody
from contactgraph.envs.planar_world import PlanarWorld
from contactgraph.evaluate import control_by_policy


def test_the_contract_is_kept() -> None:
    check_task(BlockedShotTask)


def test_pillars_stand_in_the_direct_way_and_a_way_off_a_wall_is_clear() -> None:
    task = BlockedShotTask()
    for seed in range(40):
        observation, _ = task.reset(seed=seed)
        ball, pillars = observation["position"][TARGET], observation["position"][TARGET + 1 :]
        goal, scene = task.scene.goal, task.scene
        direct = np.linspace(ball, goal, 50)[None]
        assert clearance(direct, pillars) < scene.radius[TARGET] + 0.06, "the ball does not pass"
        apart = np.linalg.norm(pillars[0] - pillars[1])
        assert apart < 2.0 * (0.06 + scene.radius[TARGET]), "nor between them"
        assert any(possible(bank_way(ball, goal, wall), pillars) for wall in range(4))
        assert np.all(np.abs(images(goal)).max(axis=1) > TABLE.min())


def test_a_ball_aimed_at_an_image_reaches_the_goal_off_the_wall() -> None:
    """The laws of Box2D: 0.9 of the velocity across a wall comes back."""
    task = BlockedShotTask()
    observation, _ = task.reset(seed=3)
    goal, ball = task.scene.goal, observation["position"][TARGET]
    pillars = observation["position"][TARGET + 1 :]
    wall = [possible(bank_way(ball, goal, each), pillars) for each in range(4)].index(True)
    shot = images(goal)[wall] - ball
    start = PlanarBody(
        ball,
        0.5,
        radius=0.04,
        velocity=1.6 * shot / np.linalg.norm(shot),
        restitution=RESTITUTION,
        ground_friction=GROUND_FRICTION,
    )
    world = PlanarWorld([start], task.scene.dt, walls=np.array([-TABLE, TABLE]))
    nearest = np.inf
    for _ in range(60):
        world.step(np.zeros((1, 2)))
        nearest = min(nearest, float(np.linalg.norm(world.position[0] - goal)))
    assert nearest < 0.06


def test_the_shooter_plays_off_a_wall_and_sometimes_arrives() -> None:
    metrics, trajectories = control_by_policy(BankShotPolicy(noise=0.0), BlockedShotTask, 6, 0)
    assert metrics.success_rate > 0.0
    ball = np.array([each.position[:, TARGET] for each in trajectories])
    assert (np.abs(ball) > TABLE - 0.06).any()
    assert sum(each.contact[:, CUE, TARGET].any() for each in trajectories) > 3
