"""The bank shot: layouts that only a bounce off a wall solves."""

import numpy as np
import pytest

from contactgraph.envs import BankShotPolicy, BankShotTask, BilliardsExpert, check_task
from contactgraph.envs.bank_shot import bank_way, clearance, images, possible
from contactgraph.envs.billiards import CUE, GROUND_FRICTION, RESTITUTION, TABLE, TARGET
from contactgraph.envs.planar_body import PlanarBody
from contactgraph.envs.planar_world import PlanarWorld
from contactgraph.evaluate import control_by_policy


def test_the_contract_is_kept() -> None:
    check_task(BankShotTask)


def test_pillars_stand_in_the_direct_way_and_a_way_off_a_wall_is_clear() -> None:
    task = BankShotTask()
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
    task = BankShotTask()
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


@pytest.mark.parametrize(("policy", "solves"), [(BankShotPolicy, True), (BilliardsExpert, False)])
def test_the_scripted_shooter_banks_and_the_direct_one_does_not(policy, solves) -> None:
    metrics, trajectories = control_by_policy(policy(noise=0.0), BankShotTask, 6, 0)
    assert (metrics.success_rate > 0.0) == solves
    struck = [each.contact[:, CUE, TARGET].any() for each in trajectories]
    assert sum(struck) > 3
