"""Bodies with a shape, on their real engines: motion, energy, labels and outlines."""

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import (
    ChainTask,
    DominoesTask,
    ExplorationPolicy,
    PickupExpert,
    RestPolicy,
    StackTask,
    TossTask,
    fallen,
)
from contactgraph.envs.episodes import run_episode
from contactgraph.envs.mujoco_world import VerticalWorld
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.evaluate.trajectory_prediction import pin_gaps

G = 9.81
BOX = np.array([0.05, 0.03])


@pytest.fixture(scope="module")
def tosses():
    return [run_episode(TossTask(), RestPolicy(), seed) for seed in range(12)]


@pytest.fixture(scope="module")
def rows():
    return [run_episode(DominoesTask(), RestPolicy(), seed) for seed in (0, 6, 8)]


@pytest.fixture(scope="module")
def stacks():
    return [run_episode(StackTask(), RestPolicy(), seed) for seed in range(3)]


def vertices(run):
    """[T+1, N, 4, 2] m: the recorded outlines in the world."""
    cos, sin = np.cos(run.orientation[..., 0]), np.sin(run.orientation[..., 0])
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    outlines = np.stack(run.scene.polygons)[run.scene.polygon_of]
    return run.position[:, :, None] + np.einsum("tnij,nvj->tnvi", turn, outlines)


def energy(run):
    """[T+1] J, by the recorded state."""
    sides = np.ptp(np.stack(run.scene.polygons), axis=1)
    mass = run.scene.mass
    inertia = mass * np.sum(sides**2, axis=-1) / 12.0
    moving = mass * np.sum(run.velocity**2, axis=-1) + inertia * run.angular_velocity[..., 0] ** 2
    return np.sum(0.5 * moving + mass * G * run.position[..., 1], axis=-1)


def gap(one, other):
    """m: distance of two convex outlines [4, 2] across the side that parts them best."""
    best = -np.inf
    for first, second in ((one, other), (other, one)):
        side = np.roll(first, -1, axis=0) - first
        normal = np.stack([side[:, 1], -side[:, 0]], -1) / np.linalg.norm(side, axis=-1)[:, None]
        away = (second @ normal.T - np.sum(first * normal, axis=-1)).min(axis=0)
        best = max(best, away.max())
    return best


@pytest.mark.parametrize(("task", "kind", "count"), [(TossTask, "box", 1), (StackTask, "box", 3)])
def test_the_scene_describes_its_bodies(task, kind, count):
    made = task()
    made.reset(seed=5)
    scene = made.scene
    assert scene.node_type == (kind,) * count and not scene.actuated.any()
    assert scene.control_kind == () and made.action_space.shape == (0,)
    assert scene.planes.tolist() == [[0.0, 1.0, 0.0]] and scene.gravity.tolist() == [0.0, -G]
    assert np.ptp(scene.polygons[0], axis=0).tolist() == [0.1, 0.06]
    assert scene.polygon_of.tolist() == list(range(count)) and (scene.mass == 0.5).all()
    assert (scene.metadata["task"], scene.metadata["seed"]) == (made.name, 5)


def test_a_toss_flies_freely_until_its_lowest_corner_is_on_the_floor(tosses):
    for run in tosses:
        lowest = vertices(run)[:, 0, :, 1].min(axis=-1)
        flight = int(np.argmax(lowest < 0.03)) - 1
        assert flight > 3
        time = run.scene.dt * np.arange(flight)
        start, turned = run.velocity[0, 0], run.orientation[0, 0, 0]
        np.testing.assert_allclose(
            run.velocity[:flight, 0], start - np.outer(time, [0.0, G]), atol=1e-9
        )
        np.testing.assert_allclose(
            run.orientation[:flight, 0, 0],
            turned + run.angular_velocity[0, 0, 0] * time,
            atol=1e-9,
        )


def test_a_toss_stays_above_the_floor_and_ends_flat_on_it(tosses):
    for run in tosses:
        lowest = vertices(run)[:, 0, :, 1]
        assert lowest.min() > -1e-3
        assert np.sort(np.abs(lowest[-1]))[:2].max() < 1e-4, "two corners on the floor"
        assert run.scene.metadata["success"] is True
        assert np.abs(run.velocity[-1]).max() < 1e-3 and not run.contact.any()
    spin = np.array([run.angular_velocity[0, 0, 0] for run in tosses])
    assert np.ptp(spin) > 10.0 and np.ptp([run.position[0, 0, 1] for run in tosses]) > 0.15


def test_angles_are_not_wrapped(tosses):
    for run in tosses:
        step = np.diff(run.orientation[:, 0, 0])
        rate = np.abs(run.angular_velocity[:, 0, 0])
        assert (np.abs(step) <= 1.5 * run.scene.dt * rate.max() + 1e-9).all()
    assert max(np.abs(run.orientation).max() for run in tosses) > np.pi


@pytest.mark.parametrize("name", ["tosses", "rows", "stacks"])
def test_energy_never_grows(name, request):
    for run in request.getfixturevalue(name):
        # Over two steps: in an impact, which is shorter than one, contacts store some.
        kept = energy(run)
        assert (kept[2:] - kept[:-2]).max() < 1e-4 * kept[0]


def test_a_sliding_box_is_decelerated_by_coulomb_friction():
    box = PlanarBody(
        np.array([0.0, 0.03]), 0.5, half_size=BOX, velocity=np.array([1.0, 0.0]), friction=0.4
    )
    world = VerticalWorld([box], 0.02)
    speed = [world.velocity[0, 0]]
    for _ in range(15):
        world.step(np.zeros((1, 2)))
        speed.append(world.velocity[0, 0])
    expected = np.maximum(1.0 - 0.4 * G * 0.02 * np.arange(16), 0.0)
    np.testing.assert_allclose(speed, expected, atol=0.02)
    assert abs(speed[-1]) < 1e-4 and abs(world.angle[0]) < 1e-4


def test_a_disc_is_refused():
    with pytest.raises(InvalidInputError, match="must be a box, found a disc"):
        VerticalWorld([PlanarBody(np.zeros(2), 1.0, radius=0.1)], 0.02)


def test_a_row_falls_from_the_left_as_far_as_it_does(rows):
    counts = []
    for run in rows:
        down = fallen(run.orientation)
        counts.append(int(down[-1].sum()))
        assert down[-1, : counts[-1]].all(), "those that fell are the first ones"
        assert (run.orientation[-1, counts[-1] :, 0] > -0.3).all()
        assert run.scene.metadata["success"] is (counts[-1] == 10)
        assert not down[0].any() and np.abs(vertices(run)[0, ..., 1].min(axis=-1)).max() < 1e-9
        assert vertices(run)[..., 1].min() > -1e-3
        when = down.argmax(axis=0)[: counts[-1]]
        assert (np.diff(when) > 0).all()
    assert counts == [6, 10, 10]


def test_dominoes_in_contact_touch_and_others_do_not(rows):
    for run in rows:
        corners, touching = vertices(run), run.contact
        for state in range(0, run.steps + 1, 5):
            moved = run.scene.dt * np.abs(run.velocity[max(state - 1, 0) : state + 1]).max()
            turned = 0.1 * run.scene.dt * np.abs(run.angular_velocity[state]).max()
            for i in range(9):
                apart = gap(corners[state, i], corners[state, i + 1])
                assert apart > -1e-3
                if touching[state, i, i + 1]:
                    assert apart < 2.0 * (moved + turned) + 1e-4
                else:
                    assert apart > -1e-6
        assert not touching[0].any()
        hit = touching[:, np.arange(9), np.arange(1, 10)].argmax(axis=0)
        count = int(fallen(run.orientation)[-1].sum())
        assert (hit[: count - 1] > 0).all() and (np.diff(hit[: count - 1]) > 0).all()


def test_a_stack_stands(stacks):
    for run in stacks:
        expected = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], dtype=bool)
        assert (run.contact == expected).all()
        assert np.abs(run.position - run.position[0]).max() < 1e-5
        assert np.abs(run.orientation).max() < 1e-5
        assert vertices(run)[..., 1].min() > -1e-4
        np.testing.assert_allclose(run.position[0, :, 1], [0.03, 0.09, 0.15])
        assert np.ptp(run.position[0, :, 0]) > 1e-3 and run.scene.metadata["success"] is True


@pytest.fixture(scope="module")
def dragged(engine):
    return [run_episode(ChainTask(), PickupExpert(), seed) for seed in range(5)] + [
        run_episode(ChainTask(), ExplorationPolicy(), seed) for seed in range(5)
    ]


def hinge_gaps(run):
    """[T+1, 2] m: gripper to the link's near end, and the link's far end to the target's."""
    along = np.concatenate([np.cos(run.orientation), np.sin(run.orientation)], axis=-1)
    near, far = run.position - 0.1 * along, run.position + 0.1 * along
    gaps = [near[:, 1] - run.position[:, 0], far[:, 1] - near[:, 2]]
    return np.linalg.norm(np.stack(gaps, axis=1), axis=-1)


def test_a_chain_keeps_together_and_bends(dragged):
    for run in dragged:
        scene = run.scene
        assert scene.node_type == ("gripper", "link", "link") and scene.polygon_of.tolist() == [
            1,
            2,
        ]
        np.testing.assert_allclose(np.ptp(scene.polygons[0], axis=0), [0.2, 0.03])
        assert hinge_gaps(run).max() < 1e-4
        expected = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], dtype=bool)
        assert (run.holding == expected).all() and (run.contact >= run.holding).all()
        angle = run.orientation[..., 0]
        found = pin_gaps(run.scene.pins, run.scene.pin_points, run.position, angle)
        assert found.shape[1] == 2 and found.max() < 1e-4
        assert not run.orientation[:, 0].any() and not run.angular_velocity[:, 0].any()
        assert not run.velocity[0].any()
        bend = run.orientation[:, 2, 0] - run.orientation[:, 1, 0]
        assert abs(bend[0]) < 1e-6
    assert np.abs(bend).max() > 0.5
    assert all(run.scene.metadata["success"] for run in dragged[:5])


def test_a_chain_that_nothing_drives_slows_down():
    task = ChainTask()
    task.reset(seed=1)
    for _ in range(20):
        task.step(np.array([5.0, -2.0]))
    mass, inertia = task.scene.mass, np.array([0.0, 1.0, 1.0]) * 0.3 * (0.2**2 + 0.03**2) / 12.0
    kept = []
    for _ in range(40):
        seen, *_ = task.step(np.zeros(2))
        moving = mass * np.sum(seen["velocity"] ** 2, axis=-1)
        kept.append(np.sum(moving + inertia * seen["angular_velocity"][:, 0] ** 2) / 2.0)
    assert kept[0] > 1.0 and np.diff(kept).max() < 0.0 and kept[-1] < 0.3 * kept[0]
