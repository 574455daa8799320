"""The Fetch environments as tasks: poses, contacts, the table's edge, and the scripted policies."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from contactgraph.data import InvalidInputError
from contactgraph.envs import AdaptedTask, RestPolicy, fetch
from contactgraph.envs.episodes import episode_seeds, run_episode
from contactgraph.interchange import read_map

pytest.importorskip(
    "gymnasium_robotics", reason="gymnasium-robotics is missing", exc_type=ImportError
)

GRIPPER, OBJECT = 0, 1
ALL = {
    "push": fetch.FetchPushTask,
    "slide": fetch.FetchSlideTask,
    "pick": fetch.FetchPickAndPlaceTask,
}


@pytest.fixture(scope="module")
def tasks() -> dict[str, AdaptedTask]:
    return {name: task() for name, task in ALL.items()}


@pytest.fixture(scope="module")
def episodes(tasks: dict[str, AdaptedTask]) -> dict[str, list[list]]:
    """By task, for each of its policies two episodes."""
    seeds = episode_seeds(2, 0)
    return {
        name: [
            [run_episode(task, make(), seed) for seed in seeds]
            for make in (task.fixed_start, task.expert, task.explorer)
        ]
        for name, task in tasks.items()
    }


@pytest.fixture(params=list(ALL))
def name(request: pytest.FixtureRequest) -> str:
    return request.param


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    with pytest.raises(InvalidInputError, match=r"pip install 'contactgraph\[fetch\]'$"):
        fetch.FetchPushTask()


@pytest.mark.parametrize("found", ["3.7.0", "4.0.0"])
def test_a_mujoco_with_other_physics_is_refused(
    found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fetch, "version", lambda name: found)
    with pytest.raises(InvalidInputError, match=f"needs a MuJoCo below 3.7, found {found}"):
        fetch.FetchPushTask()


@pytest.mark.parametrize("name", ["push", "pick"])
def test_the_fixed_start_succeeds(name: str, episodes: dict[str, list[list]]) -> None:
    for trajectory in episodes[name][0]:
        missing = trajectory.position[-1, OBJECT] - trajectory.scene.goal
        assert trajectory.scene.metadata["success"] is True
        assert np.linalg.norm(missing) < 0.025


def test_the_same_seed_repeats_an_episode_to_the_last_bit(
    name: str, tasks: dict[str, AdaptedTask], episodes: dict[str, list[list]]
) -> None:
    first = episodes[name][1][1]
    again = run_episode(tasks[name], ALL[name].expert(), int(first.scene.metadata["seed"]))
    for field in ("position", "velocity", "control", "contact", "orientation"):
        np.testing.assert_array_equal(getattr(again, field), getattr(first, field))


def test_the_pose_and_the_contact_are_the_simulators_own(tasks: dict[str, AdaptedTask]) -> None:
    task, policy = tasks["push"], fetch.FetchPushTask.fixed_start()
    observation, _ = task.reset(seed=4)
    policy.reset(task.scene, 0)
    inner, touches = task.environment.unwrapped, set()
    fingers = [inner.model.body(f"robot0:{side}_gripper_finger_link").id for side in "lr"]
    for _ in range(40):
        observation, *_ = task.step(policy(observation))
        body = inner.data.body("object0")
        np.testing.assert_allclose(observation["position"][OBJECT], body.xpos, atol=1e-12)
        pair = np.roll([observation["orientation"][OBJECT], body.xquat], -1, axis=1)
        one, other = Rotation.from_quat(pair)
        assert (one * other.inv()).magnitude() < 1e-6
        # Half diagonals and least half sides of a finger (7.7 by 1.4 by 2.7 cm) and of the block.
        distance = min(
            np.linalg.norm(inner.data.geom_xpos[geom] - body.xpos)
            for geom in range(inner.model.ngeom)
            if inner.model.geom_bodyid[geom] in fingers
        )
        if observation["contact"][GRIPPER, OBJECT]:
            assert distance < 0.0415 + 0.0434 + 0.03  # they may have parted since
        else:
            assert distance > 0.007 + 0.025
        touches.add(int(observation["contact"][GRIPPER, OBJECT]))
    assert touches == {0, 1}


def test_an_object_that_gains_speed_was_touched(episodes: dict[str, list[list]]) -> None:
    gained = 0
    for trajectory in (each for made in episodes["push"] for each in made):
        speed = np.linalg.norm(trajectory.velocity[:, OBJECT, :2], axis=1)
        gains = np.diff(speed) > 0.03
        assert trajectory.contact[1:, GRIPPER, OBJECT][gains].all()
        gained += gains.sum()
    assert gained > 20


def test_the_hand_keeps_its_orientation(tasks: dict[str, AdaptedTask]) -> None:
    task = tasks["push"]
    observation, _ = task.reset(seed=0)
    hand = task.environment.unwrapped.data.body("robot0:gripper_link").xquat
    assert abs(observation["orientation"][GRIPPER] @ hand) > 0.9999


def test_a_trajectory_ends_where_the_block_leaves_the_table(tasks: dict[str, AdaptedTask]) -> None:
    task, edge = tasks["push"], read_map("fetch-push").bodies[1].bounds[1, 0]

    class Away:
        """Pushes the block over the far edge."""

        def reset(self, scene, seed) -> None:
            self.push = fetch.FetchPushTask.fixed_start()
            self.push.reset(scene, seed)

        def __call__(self, observation) -> np.ndarray:
            beyond = observation["position"][OBJECT] + np.array([0.3, 0.0, 0.0])
            return self.push.towards(observation["position"], beyond)

    trajectory = run_episode(task, Away(), 0)
    x = trajectory.position[:, OBJECT, 0]
    assert trajectory.steps < 50 and x[-1] > edge and np.all(x[:-1] <= edge)
    assert trajectory.scene.metadata["success"] is False


def test_a_rest_moves_nothing_and_opens_no_fingers(tasks: dict[str, AdaptedTask]) -> None:
    trajectory = run_episode(tasks["pick"], RestPolicy(), 1)
    assert trajectory.control.shape == (50, 4) and not trajectory.control.any()
    # The simulator's hand sinks by some 0.1 mm a step.
    assert np.ptp(trajectory.position[5:], axis=0).max() < 0.01
    assert np.ptp(trajectory.position[5:, OBJECT], axis=0).max() < 1e-5


def test_the_fingers_close_on_the_block_and_lift_it(episodes: dict[str, list[list]]) -> None:
    for trajectory in episodes["pick"][0]:
        held = trajectory.contact[:, GRIPPER, OBJECT]
        first = int(held.argmax())
        assert np.all(trajectory.control[: first - 4, 3] == 1.0) and np.all(held[first:])
        assert np.all(trajectory.control[first:, 3] == -1.0)
        assert trajectory.scene.control_kind == ("displacement",) * 3 + ("other",)


def test_a_slide_lets_go_of_the_puck(episodes: dict[str, list[list]]) -> None:
    reach = read_map("fetch-slide").bodies[0].bounds[1, 0]
    ends = [each.position[-1] for each in episodes["slide"][0]]
    assert all(end[GRIPPER, 0] < reach for end in ends)
    assert sum(end[OBJECT, 0] > reach for end in ends) >= 1
