"""Blocks of one type and unknown mass, on Box2D."""

import numpy as np
import pytest

from contactgraph.envs import ForcedPush, UnknownMassTask
from contactgraph.envs.episodes import run_episode

DT, SLOWDOWN = 0.05, 0.1 * 9.81


@pytest.fixture(scope="module")
def pushes(engine):
    return [
        run_episode(UnknownMassTask(), ForcedPush(noise=0.0, variety=0.0), seed)
        for seed in range(20)
    ]


@pytest.fixture(scope="module")
def explored(engine):
    return [run_episode(UnknownMassTask(2), ForcedPush(random=True), seed) for seed in range(10)]


def test_blocks_look_alike_and_weigh_differently():
    task, drawn = UnknownMassTask(2), []
    for seed in range(40):
        task.reset(seed=seed)
        scene = task.scene
        assert scene.node_type == ("pusher", "block", "block", "block")
        assert (scene.radius == scene.radius[0]).all() and scene.mass[0] == 1.0
        assert not any("mass" in key for key in scene.metadata)
        drawn.append(scene.mass[1:])
    masses = np.ravel(drawn)
    assert masses.min() > 0.5 and masses.max() < 2.0
    assert np.quantile(np.log(masses), [0.25, 0.75]) == pytest.approx(
        np.log(2) / 2 * np.array([-1, 1]), abs=0.15
    )
    assert np.abs(np.corrcoef(np.transpose(drawn))[0, 1]) < 0.4, "each block has its own"
    alone = UnknownMassTask()
    alone.reset(seed=39)
    assert alone.scene.mass[1] == scene.mass[1], "further blocks change nothing of the target"


def test_the_mass_decides_what_a_push_does(pushes):
    """Momentum: what the force gives, but for friction with the table."""
    met = 0
    for run in pushes:
        mass, control = run.scene.mass, run.control
        touching = run.contact[1:, 0, 1]
        gained = np.diff(run.velocity * mass[:, None], axis=0).sum(axis=1)
        lost = np.linalg.norm(gained - control * DT, axis=-1)
        assert (lost <= SLOWDOWN * mass[1] * DT + 1e-4).all()
        free = ~touching
        np.testing.assert_allclose(
            np.diff(run.velocity[:, 0], axis=0)[free], DT * control[free], atol=1e-4
        )
        met += int(touching.sum())
    assert met > 500


def test_all_blocks_slow_down_alike(explored):
    seen = 0
    for run in explored:
        speed = np.linalg.norm(run.velocity, axis=-1)
        free = ~run.contact[1:].any(axis=-1)
        free[:, 0] = False
        expected = np.maximum(speed[:-1] - SLOWDOWN * DT, 0.0)
        np.testing.assert_allclose(speed[1:][free], expected[free], atol=1e-4)
        seen += int((speed[:-1][free] > 0.1).sum())
    assert seen > 20


def test_the_demonstrator_brings_blocks_of_any_mass_to_the_goal(pushes):
    assert np.mean([run.scene.metadata["success"] for run in pushes]) >= 0.9
    last = pushes[0]
    distance = np.linalg.norm(last.position[-1, 1] - last.scene.goal)
    assert last.scene.metadata["success"] is bool(distance <= 0.02)


def test_exploration_touches_blocks_and_stays_near(explored):
    assert np.mean([run.contact[:, 0, 1].any() for run in explored]) >= 0.8
    assert max(np.abs(run.position[:, 0]).max() for run in explored) < 1.3
