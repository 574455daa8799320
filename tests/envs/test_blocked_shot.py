"""The blocked shot: pillars in the direct way, and a reach of the cue that leaves only a bank."""

import numpy as np
import pytest

from contactgraph.data import InvalidInputError, Scene, Trajectory
from contactgraph.envs import BankShotPolicy, BilliardsExpert, BlockedShotTask, check_task
from contactgraph.envs.billiards import (
    CUE,
    GOAL_RADIUS,
    GROUND_FRICTION,
    RESTITUTION,
    TABLE,
    TARGET,
    BilliardsTask,
)
from contactgraph.envs.billiards_policies import StrikingPolicy
from contactgraph.envs.blocked_shot import clearance, images, possible
from contactgraph.envs.planar_body import PlanarBody
from contactgraph.envs.planar_world import PlanarWorld
from contactgraph.evaluate import control_by_policy

DT = 0.05


def bound(scene: Scene) -> tuple[int, int, int]:
    """The wall beyond the one bound of the cue's reach, its axis, and its side."""
    ((upper, axis),) = np.argwhere(np.isfinite(scene.reach[CUE]))
    return int(axis + 2 * (1 - upper)), int(axis), 2 * int(upper) - 1


def towards_wall(run: Trajectory, node: int) -> np.ndarray:
    """[T+1] m, along the normal of that wall."""
    _, axis, side = bound(run.scene)
    return side * run.position[:, node, axis]


def test_the_contract_is_kept() -> None:
    check_task(BlockedShotTask)


def test_every_layout_needs_a_bank_and_has_a_clear_one_within_reach() -> None:
    task, walls = BlockedShotTask(), set()
    for seed in range(40):
        observation, _ = task.reset(seed=seed)
        ball, pillars = observation["position"][TARGET], observation["position"][TARGET + 1 :]
        goal, scene = task.scene.goal, task.scene
        direct = np.linspace(ball, goal, 50)[None]
        assert clearance(direct, pillars) < scene.radius[TARGET] + 0.06, "the ball does not pass"
        apart = np.linalg.norm(pillars[0] - pillars[1])
        assert apart < 2.0 * (0.06 + scene.radius[TARGET]), "nor between them"
        wall, axis, side = bound(scene)
        walls.add(wall)
        assert possible(ball, goal, wall, pillars)
        assert np.all(np.abs(images(goal)).max(axis=1) > TABLE.min())
        # The wall is nearer to the ball than goal, pillars and cue are, wherever the cue goes.
        others = np.array([goal, *pillars, observation["position"][CUE]])[:, axis]
        assert np.all(side * (ball[axis] - others) > 0.0)
        assert side * (ball[axis] - goal[axis]) > GOAL_RADIUS
        assert side * (ball[axis] - scene.reach[CUE, int(side > 0), axis]) == pytest.approx(0.03)
        assert np.isnan(scene.reach[TARGET:]).all()
    assert len(walls) > 2


def test_a_ball_aimed_at_an_image_reaches_the_goal_off_the_wall() -> None:
    """The laws of Box2D: 0.9 of the velocity across a wall comes back."""
    task = BlockedShotTask()
    observation, _ = task.reset(seed=3)
    goal, ball = task.scene.goal, observation["position"][TARGET]
    wall, _, _ = bound(task.scene)
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


@pytest.fixture(scope="module")
def played() -> dict[str, list[Trajectory]]:
    """Twelve episodes by a shooter off the wall, one straight at the goal, and one at random."""
    policies = {
        "bank": BankShotPolicy(noise=0.0),
        "direct": BilliardsExpert(noise=0.0),
        "random": StrikingPolicy(),
    }
    return {
        name: list(control_by_policy(policy, BlockedShotTask, 12, 100)[1])
        for name, policy in policies.items()
    }


def arrives(run: Trajectory) -> bool:
    return np.linalg.norm(run.position[-1, TARGET] - run.scene.goal) <= GOAL_RADIUS


def test_whoever_plays_the_ball_turns_back_at_the_wall_only(played) -> None:
    turns = 0
    for run in (run for runs in played.values() for run in runs):
        _, axis, side = bound(run.scene)
        across, speed = towards_wall(run, TARGET), side * run.velocity[:, TARGET, axis]
        back = np.flatnonzero(speed < -0.01)
        turns += len(back) > 0
        first = back[0] if len(back) else len(across)
        assert np.all(across[:first] > across[0] - 1e-3)
        if len(back):
            limit = TABLE[axis] - run.scene.radius[TARGET]
            assert across[first - 1] + DT * speed[first - 1] > limit - 0.03
    assert turns > 12


def test_the_cue_stops_at_the_bound_of_its_reach(played) -> None:
    nearest = []
    for run in played["random"] + played["direct"]:
        _, axis, side = bound(run.scene)
        across = towards_wall(run, CUE) - side * run.scene.reach[CUE, int(side > 0), axis]
        nearest.append(across.max())
    assert -1e-3 < max(nearest) < 1e-3


def test_only_a_bank_arrives(played) -> None:
    """And one strike is enough."""
    assert not any(arrives(run) for run in played["direct"])
    arrived = [run for run in played["bank"] if arrives(run)]
    begins = [np.diff(run.contact[:, CUE, TARGET].astype(int)) > 0 for run in arrived]
    assert len(arrived) >= 9 and sum(each.sum() == 1 for each in begins) >= 8


def test_a_bank_shot_needs_a_bound_of_the_reach() -> None:
    task = BilliardsTask()
    task.reset(seed=0)
    with pytest.raises(InvalidInputError, match="a bank shot needs the bound of the cue's reach"):
        BankShotPolicy().reset(task.scene, 0)
