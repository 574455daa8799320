from functools import partial

import numpy as np
import pytest

from contactgraph.envs import BilliardsExpert, BilliardsTask, RestPolicy, StrikingPolicy
from contactgraph.envs.billiards import CORRIDOR, GAP, SHOT, TABLE
from contactgraph.evaluate import collect

DT = 0.05
SLOWDOWN = 0.05 * 9.81
"""By friction with the table, m/s^2."""
PASSIVE = partial(BilliardsTask, 6, passive=True)


@pytest.fixture(scope="module")
def passive_runs(engine):
    return collect([PASSIVE], [RestPolicy()], 30, 0)


def test_the_scene_describes_its_nodes():
    task = BilliardsTask(3)
    observation, _ = task.reset(seed=5)
    scene = task.scene
    assert scene.node_name == ("cue", "target", "object-1", "object-2", "pillar-1", "pillar-2")
    assert scene.node_type == ("cue", "ball", "puck", "ball", "pillar", "pillar")
    assert scene.actuated.tolist() == [True, False, False, False, False, False]
    assert scene.static.tolist() == [False, False, False, False, True, True]
    assert scene.mass.tolist() == [1.0, 0.5, 1.5, 0.5, 1.0, 1.0]
    assert scene.radius.tolist() == [0.05, 0.04, 0.06, 0.04, 0.06, 0.06]
    assert scene.control_kind == ("force", "force")
    assert scene.planes.tolist() == [[1, 0, -1], [0, 1, -0.6], [-1, 0, -1], [0, -1, -0.6]]
    distance = observation["position"] @ scene.planes[:, :2].T - scene.planes[:, 2]
    assert (distance.min(axis=1) > scene.radius).all(), "all begin within the walls"
    law = {name: scene.metadata[name] for name in ("restitution", "friction", "ground_friction")}
    assert law == {"restitution": 0.9, "friction": 0.1, "ground_friction": 0.05}
    assert (scene.metadata["task"], scene.metadata["seed"]) == ("billiards", 5)


def test_without_the_cue_the_target_is_the_first_node_and_the_control_is_empty():
    driven, passive = BilliardsTask(3), BilliardsTask(3, passive=True)
    before, _ = driven.reset(seed=5)
    observation, _ = passive.reset(seed=5)
    scene = passive.scene
    assert scene.node_name == driven.scene.node_name[1:] and not scene.actuated.any()
    assert scene.control_kind == () and passive.action_space.shape == (0,)
    assert np.array_equal(observation["position"], before["position"][1:])
    speed = np.linalg.norm(observation["velocity"], axis=-1)
    assert (speed[:3] >= 0.3 - 1e-6).all() and (speed[:3] <= 1.5).all() and not speed[3:].any()
    assert not before["velocity"].any()
    assert (driven.max_steps, passive.max_steps) == (200, 80)
    assert (driven.cost_terms().chain, passive.cost_terms().chain) == ((0, 1), (0,))


@pytest.mark.parametrize("objects", [1, 8])
def test_everything_begins_apart_and_the_shot_is_free(objects):
    for seed in range(20):
        task = BilliardsTask(objects)
        observation, _ = task.reset(seed=seed)
        position, goal, radius = observation["position"], observation["goal"], task.scene.radius
        apart = np.linalg.norm(position[:, None] - position, axis=-1) - radius[:, None] - radius
        assert apart[np.triu_indices(len(position), 1)].min() >= GAP - 1e-6
        shot = goal - position[1]
        assert SHOT[0] <= np.linalg.norm(shot) <= SHOT[1] and (np.abs(goal) <= TABLE).all()
        line = position[1] + np.linspace(0.0, 1.0, 50)[:, None] * shot
        assert np.linalg.norm(position[2:, None] - line, axis=-1).min() >= CORRIDOR - 0.01


def wall_distance(run):
    """[T+1, N] m from each surface to the nearest wall."""
    planes = run.scene.planes
    return (run.position @ planes[:, :2].T - planes[:, 2]).min(axis=-1) - run.scene.radius


def test_free_objects_decelerate_by_friction_with_the_table_until_they_rest(passive_runs):
    rests = 0
    for run in passive_runs:
        moving = ~run.scene.static
        hit = run.contact[1:].any(axis=-1) | (wall_distance(run)[1:] < 0.1)
        hit |= wall_distance(run)[:-1] < 0.1
        speed = np.linalg.norm(run.velocity, axis=-1)
        expected = np.maximum(speed[:-1] - SLOWDOWN * DT, 0.0)
        free = ~hit & moving
        np.testing.assert_allclose(speed[1:][free], expected[free], atol=1e-5)
        turn = run.velocity[1:] * speed[:-1, :, None] - run.velocity[:-1] * speed[1:, :, None]
        assert np.abs(turn[free]).max() < 1e-4
        rests += int((speed[-1][moving] == 0.0).sum())
    assert rests > 60, "most objects rest in the end, to the last bit"


def test_two_objects_exchange_momentum_and_separate_with_the_restitution(passive_runs):
    ratios, slopes = [], []
    for run in passive_runs:
        mass, moving = run.scene.mass, ~run.scene.static
        near_wall = wall_distance(run) < 0.1
        for step in range(1, run.steps + 1):
            pairs = np.argwhere(np.triu(run.contact[step]))
            if len(pairs) != 1 or run.contact[step - 1].any() or not moving[pairs[0]].all():
                continue
            i, j = pairs[0]
            if near_wall[step - 1 : step + 1, [i, j]].any():
                continue
            before, after = run.velocity[step - 1], run.velocity[step]
            momentum = mass[[i, j]] @ (after - before)[[i, j]]
            # Friction with the table takes at most m mu g dt from each.
            assert np.linalg.norm(momentum) <= mass[[i, j]].sum() * SLOWDOWN * DT + 1e-5
            normal = run.position[step, j] - run.position[step, i]
            middle = run.position[step - 1, j] - run.position[step - 1, i]
            normal = normal / np.linalg.norm(normal) + middle / np.linalg.norm(middle)
            normal /= np.linalg.norm(normal)
            closing = -(before[j] - before[i]) @ normal
            if closing > 0.5:
                ratios.append((after[j] - after[i]) @ normal / closing)
            tangent = np.array([-normal[1], normal[0]])
            sliding = (before[j] - before[i]) @ tangent
            gained = (after[j] - after[i]) - (before[j] - before[i])
            if abs(sliding) > 0.3 and closing > 0.3:
                slopes.append(-np.sign(sliding) * (gained @ tangent) / (gained @ normal))
    assert len(ratios) >= 10 and len(slopes) >= 10
    assert np.median(ratios) == pytest.approx(0.9, abs=0.05)
    assert np.median(slopes) == pytest.approx(0.1, abs=0.03), "Coulomb friction while they slide"


def test_energy_only_falls_and_pillars_stand_still(passive_runs):
    struck = 0
    for run in passive_runs:
        moving = ~run.scene.static
        energy = 0.5 * np.sum(run.velocity**2, axis=-1)[:, moving] @ run.scene.mass[moving]
        assert (np.diff(energy) <= 1e-6).all()
        pillars = run.position[:, ~moving]
        assert np.array_equal(pillars, np.broadcast_to(pillars[0], pillars.shape))
        assert not run.velocity[:, ~moving].any()
        struck += run.contact[:, ~moving].any()
        assert wall_distance(run).min() > -1e-3
    assert struck > 3


@pytest.mark.usefixtures("engine")
def test_the_expert_brings_the_target_to_the_goal_with_noise_and_without():
    runs = collect([BilliardsTask], [BilliardsExpert(0.0), BilliardsExpert(0.5)], 20, 0)
    assert sum(bool(run.scene.metadata["success"]) for run in runs) >= 19
    for run in runs:
        distance = np.linalg.norm(run.position[-1, 1] - run.scene.goal)
        assert run.scene.metadata["success"] == (distance <= 0.1)
        assert np.linalg.norm(run.position[0, 1] - run.scene.goal) >= 0.4


def test_success_is_at_the_end_and_of_the_target():
    task = BilliardsTask(2)
    task.reset(seed=0)
    position, still = task.world.position, np.zeros((5, 5), dtype=bool)
    position[1] = task.scene.goal + np.array([0.0999, 0.0])
    assert task.solved(task.scene, position, still) and not task.success()
    position[[1, 2]] = position[[2, 1]]
    assert not task.solved(task.scene, position, still)


@pytest.mark.usefixtures("engine")
def test_exploration_strikes_objects_of_both_types():
    runs = collect([BilliardsTask], [StrikingPolicy()], 10, 0)
    struck = np.array([run.contact[:, 0, 1:4].any(axis=0) for run in runs])
    assert (struck.sum(axis=0) >= 4).all()
    assert all(np.abs(run.position).max() < 1.0 for run in runs)


def test_targets_and_goal_are_shared_with_a_fixed_seed_and_all_else_is_not():
    scenes = []
    for objects, seed in [(1, 0), (3, 1), (8, 2)]:
        task = BilliardsTask(objects, fixed_seed=7)
        scenes.append((task.reset(seed=seed)[0]["position"], task.scene))
    for position, scene in scenes[1:]:
        assert np.array_equal(scene.goal, scenes[0][1].goal)
        assert np.array_equal(position[1], scenes[0][0][1])
        assert not np.array_equal(position[0], scenes[0][0][0])
        assert scene.metadata["fixed_seed"] == 7
