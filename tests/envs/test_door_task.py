import numpy as np
import pytest

from contactgraph.envs import DoorExpert, DoorTask, ExplorationPolicy
from contactgraph.envs.door import CORRIDOR, DISTRACTOR_HALF_WIDTH, sample_layout
from contactgraph.envs.gripper_task import fixed_layout
from contactgraph.evaluate import collect

SEEDS = range(30)
FLOAT32 = 2e-6


@pytest.fixture(scope="module")
def expert_runs(engine):
    return collect([DoorTask], [DoorExpert()], 30, 0)


def bar(hinge, angle, points=60):
    """[P, 2] m along a door."""
    return hinge + np.linspace(0.0, 1.0, points)[:, None] * [np.cos(angle), np.sin(angle)]


def nearest(one, other):
    return np.linalg.norm(one[:, None] - other, axis=-1).min()


@pytest.mark.parametrize("fixed_seed", [None, 3])
def test_the_layout_keeps_its_distances(fixed_seed):
    fixed = fixed_layout(fixed_seed, lambda rng: sample_layout(rng, 10))
    for seed in SEEDS[:15]:
        layout = sample_layout(np.random.default_rng(seed), 10, fixed)
        hinge, angle, goal = layout.hinge[0], layout.angle[0], layout.goal_angle
        assert nearest(layout.gripper[None], bar(hinge, angle)) >= 0.4 - 1e-3
        assert np.abs(layout.gripper).max() <= 1.0 and np.abs(hinge).max() <= 0.2
        assert np.abs(layout.hinge).max() <= DISTRACTOR_HALF_WIDTH
        way = bar(hinge, angle)[29:31].mean(axis=0) - layout.gripper
        across = way @ [-np.sin(angle), np.cos(angle)]
        assert abs(across) >= np.linalg.norm(way) * np.cos(np.deg2rad(60.0)) - 1e-6
        low, high = sorted([angle, goal])
        turns = np.linspace(low - np.deg2rad(20), high + np.deg2rad(20), 25)
        taken = np.concatenate([bar(hinge, turn) for turn in turns])
        taken = np.concatenate([taken, layout.gripper + np.linspace(0, 1, 60)[:, None] * way])
        others = [bar(*door) for door in zip(layout.hinge[1:], layout.angle[1:], strict=True)]
        for index, other in enumerate(others):
            assert nearest(other, taken) >= CORRIDOR - 3e-3
            assert all(nearest(other, each) >= CORRIDOR - 3e-3 for each in others[:index])


def test_doors_point_and_swing_in_all_directions():
    layouts = [sample_layout(np.random.default_rng(seed), 0) for seed in SEEDS]
    directions = [layout.angle[0] for layout in layouts]
    swings = np.rad2deg([layout.goal_angle - layout.angle[0] for layout in layouts])
    assert np.abs(swings).min() >= 20.0 and np.abs(swings).max() <= 80.0
    assert min(swings) < -50.0 and max(swings) > 50.0
    assert np.ptp(directions) > 4.0


def test_the_scene_describes_its_nodes(engine):
    task = DoorTask(2)
    observation, _ = task.reset(seed=5)
    scene = task.scene
    assert scene.node_name == ("gripper", "door", "distractor-0", "distractor-1")
    assert scene.node_type == ("gripper", "door", "door", "door")
    assert scene.actuated.tolist() == [True, False, False, False]
    assert scene.mass.tolist() == [1.0, 4.0, 4.0, 4.0]
    assert scene.radius.tolist() == [0.04, 0.025, 0.025, 0.025]
    assert scene.candidate_edges.tolist() == [[0, 1], [0, 2], [0, 3]]
    assert np.isnan(scene.anchor[0]).all()
    arms = observation["position"][1:] - scene.anchor[1:]
    np.testing.assert_allclose(np.linalg.norm(arms, axis=-1), 0.5, atol=1e-6)
    assert np.linalg.norm(scene.goal - scene.anchor[1]) == pytest.approx(0.5)
    data = scene.metadata
    assert (data["task"], data["seed"], data["distractors"], data["substeps"]) == ("door", 5, 2, 10)
    assert data["angle"] == pytest.approx(np.arctan2(arms[0, 1], arms[0, 0]), abs=1e-6)
    aim = scene.anchor[1] + 0.5 * np.array([np.cos(data["goal_angle"]), np.sin(data["goal_angle"])])
    np.testing.assert_allclose(scene.goal, aim)
    assert data["simulator"].startswith(f"{engine} ")


def test_success_is_a_grasped_door_at_its_goal():
    task = DoorTask()
    task.reset(seed=0)
    position = np.array([[0.0, 0.0], task.scene.goal + np.array([0.0499, 0.0])])
    held = np.array([[False, True], [True, False]])
    assert task.solved(task.scene, position, held)
    assert not task.solved(task.scene, position, np.zeros((2, 2), dtype=bool))
    assert not task.solved(task.scene, position + 0.001, held)


def test_the_expert_succeeds_and_strikes_the_door_at_speed(expert_runs):
    ended = [np.linalg.norm(run.position[-1, 1] - run.scene.goal) for run in expert_runs]
    assert max(ended) <= 0.05 and all(run.contact[-1, 0, 1] for run in expert_runs)
    touched = [int(run.contact[:, 0, 1].argmax()) for run in expert_runs]
    assert max(touched) < 30
    speed = [
        np.linalg.norm(run.velocity[t - 1, 0]) for run, t in zip(expert_runs, touched, strict=True)
    ]
    assert min(speed) > 0.3


def test_among_distractors_the_expert_does_just_the_same(expert_runs):
    few = collect([lambda: DoorTask(5)], [DoorExpert()], 5, 0)
    for alone, run in zip(expert_runs, few, strict=False):
        assert np.array_equal(alone.position, run.position[:, :2])
        assert not run.velocity[:, 2:].any() and not run.contact[:, 2:].any()
        assert np.array_equal(run.position[0, 2:], run.position[-1, 2:])


def test_recorded_doors_stay_on_their_hinges_and_grippers_on_their_pins(expert_runs):
    for run in expert_runs:
        arm = run.position[:, 1] - run.scene.anchor[1]
        np.testing.assert_allclose(np.linalg.norm(arm, axis=-1), 0.5, atol=FLOAT32)
        assert np.abs(np.einsum("td,td->t", arm, run.velocity[:, 1])).max() < FLOAT32
        held = run.contact[:, 0, 1]
        apart = np.linalg.norm(run.position[:, 0] - run.position[:, 1], axis=-1)[held]
        assert np.ptp(apart) < 1e-4


@pytest.mark.usefixtures("engine")
def test_exploration_strikes_the_door_at_many_positions():
    runs = collect([DoorTask], [ExplorationPolicy()], 40, 0)
    places = []
    for run in runs:
        if run.contact.any():
            step = int(run.contact[:, 0, 1].argmax())
            places.append(np.linalg.norm(run.position[step, 0] - run.scene.anchor[1]))
    assert 20 <= len(places) < 40
    assert min(places) < 0.2 and max(places) > 0.6
