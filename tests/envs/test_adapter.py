"""A Gymnasium environment becomes a task by its map."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from contactgraph.cli import main as cli
from contactgraph.data import InvalidInputError, read_trajectories
from contactgraph.envs import AdaptedTask, ChainCost, RestPolicy, check_task
from contactgraph.envs.episodes import run_episode
from contactgraph.interchange import parse_map

ORDER = "XYZ"


class Carousel(gymnasium.Env):
    """A hand (cm) that goes where it is told, and a box that turns beside it in space."""

    observation_space = gymnasium.spaces.Dict(
        state=gymnasium.spaces.Box(-1e4, 1e4, (16,), np.float64),
        target=gymnasium.spaces.Box(-1e4, 1e4, (3,), np.float64),
    )
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.hand = self.np_random.uniform(-10.0, 10.0, 3)
        self.sign = 1.0
        self.box, self.angles = self.hand + np.array([8.0, 0.0, 0.0]), np.array([3.1, 0.2, -0.1])
        return self._observation(), {}

    def step(self, action):
        assert action.dtype == np.float32 and action[3] == 0.25
        self.hand = self.hand + 2.0 * action[:3]
        self.angles = self.angles + np.array([0.05, 0.0, 0.0])
        return self._observation(), 1.5, False, False, {"done": self.hand[0] > 5.0}

    def _observation(self):
        rates = 7.0 * np.ones(3)  # wrong on purpose
        pose = np.roll(Rotation.from_euler(ORDER, self.angles).as_quat(), 1)
        self.sign = -self.sign  # both signs are the same pose
        relative = self.box - self.hand
        state = np.concatenate([self.hand, relative, self.angles, rates, self.sign * pose])
        return {"state": state, "target": np.array([30.0, 0.0, 0.0])}


MAP = f"""
dimension = 3
goal = {{ columns = "observations/target", scale = 0.01 }}

[time]
dt = 0.1

[[body]]
name = "hand"
type = "hand"
actuated = true
position = {{ columns = "observations/state[0:3]", scale = 0.01 }}
orientation = [1.0, 0.0, 0.0, 0.0]
radius = 0.03
mass = 1.0

[[body]]
name = "box"
position = {{ columns = "observations/state[3:6]", scale = 0.01 }}
orientation = {{ columns = "observations/state[6:9]", euler = "{ORDER}" }}
relative_to = "hand"
radius = 0.02
mass = 2.0

[[control]]
columns = "actions[0:3]"
kind = "displacement"
body = "hand"
scale = 0.02
"""
VELOCITY = 'velocity = { columns = "observations/state[9:12]", scale = 0.01 }'
COST = ChainCost((0, 1), np.ones(6), np.ones(6), 0.1)


def task(*changes: tuple[str, str], **arguments) -> AdaptedTask:
    """The carousel, with texts of the map replaced by others and other arguments."""
    text = MAP
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    given = {"name": "carousel", "cost": COST, "max_steps": 20, "tolerance": 0.5, "rest": 0.25}
    return AdaptedTask(Carousel, parse_map("a map", text), **{**given, **arguments})


BOX_BOUNDS = ("mass = 2.0", "mass = 2.0\nbounds = [[-9, -9, -9], [0.18, 9, 9]]")
HAND_BOUNDS = ("radius = 0.03", "radius = 0.03\nbounds = [[-9, -9, -9], [0.18, 9, 9]]")


class Steady:
    """The same control at every step."""

    def __init__(self, control) -> None:
        self.control = np.array(control)

    def reset(self, scene, seed) -> None:
        pass

    def __call__(self, observation) -> np.ndarray:
        return self.control


def test_the_contract_is_kept() -> None:
    check_task(task)


def test_positions_controls_and_goal_are_in_metres() -> None:
    carousel = task()
    observation, _ = carousel.reset(seed=3)
    inner = carousel.environment
    np.testing.assert_allclose(observation["position"], [inner.hand / 100, inner.box / 100])
    np.testing.assert_allclose(observation["goal"], [0.3, 0.0, 0.0])
    np.testing.assert_allclose(carousel.action_space.high, [0.02] * 3)
    following, reward, *_ = carousel.step(np.array([0.01, 0.0, -1.0]))
    moved = following["position"][0] - observation["position"][0]
    np.testing.assert_allclose(moved, [0.01, 0.0, -0.02], atol=1e-9)
    assert reward == 1.5


def test_velocities_are_backward_differences_of_what_was_recorded() -> None:
    trajectory = run_episode(task(), Steady([0.01, -0.005, 0.0]), 0)
    position, velocity = trajectory.position, trajectory.velocity
    assert np.all(velocity[0] == 0.0)
    np.testing.assert_allclose(position[:-1] + 0.1 * velocity[1:], position[1:], atol=1e-12)
    np.testing.assert_allclose(velocity[1:, 0, :2], [[0.1, -0.05]] * 20, atol=1e-6)


def test_given_velocities_are_read_and_those_of_a_relative_body_added() -> None:
    with_velocity = [(f"radius = 0.0{n}", f"radius = 0.0{n}\n{VELOCITY}") for n in (3, 2)]
    trajectory = run_episode(task(*with_velocity), Steady([0.0] * 3), 0)
    np.testing.assert_allclose(trajectory.velocity[:, 0], 0.07)
    np.testing.assert_allclose(trajectory.velocity[:, 1], 0.14)


def test_orientations_are_the_environments_and_turn_at_their_rate() -> None:
    carousel = task()
    trajectory = run_episode(carousel, Steady([0.0] * 3), 0)
    last = np.roll(trajectory.orientation[-1, 1], -1)
    expected = Rotation.from_euler(ORDER, carousel.environment.angles)
    assert (Rotation.from_quat(last) * expected.inv()).magnitude() < 1e-9
    products = np.sum(trajectory.orientation[1:, 1] * trajectory.orientation[:-1, 1], axis=1)
    assert products.min() > 0.9
    # The first of the intrinsic angles turns about the world's first axis.
    np.testing.assert_allclose(
        trajectory.angular_velocity[1:, 1], [[0.5, 0.0, 0.0]] * 20, atol=1e-9
    )
    np.testing.assert_allclose(trajectory.orientation[:, 0], [[1.0, 0.0, 0.0, 0.0]] * 21)


def test_the_sign_of_a_quaternion_does_not_jump() -> None:
    euler = run_episode(task(), Steady([0.0] * 3), 0).orientation
    quaternion = '{ columns = "observations/state[12:16]", order = "wxyz" }'
    jumping = f'{{ columns = "observations/state[6:9]", euler = "{ORDER}" }}', quaternion
    orientation = run_episode(task(jumping), Steady([0.0] * 3), 0).orientation
    assert orientation is not None and euler is not None
    assert np.sum(orientation[1:, 1] * orientation[:-1, 1], axis=1).min() > 0.9
    np.testing.assert_allclose(np.abs(orientation), np.abs(euler), atol=1e-12)


def test_a_reference_is_a_point_of_the_turned_body() -> None:
    carousel = task(("mass = 2.0", "mass = 2.0\nreference = [0.0, 0.1, 0.0]"))
    observation, _ = carousel.reset(seed=0)
    inner = carousel.environment
    away = Rotation.from_euler(ORDER, inner.angles).apply([0.0, 0.1, 0.0])
    np.testing.assert_allclose(observation["position"][1], inner.box / 100 + away)


def test_bodies_touch_where_their_radii_reach() -> None:
    carousel = task()
    carousel.reset(seed=0)
    for expected in (0, 0, 1):  # the box stays 8 cm ahead of the start
        observation, *_ = carousel.step(np.array([0.012, 0.0, 0.0]))
        gap = np.linalg.norm(np.diff(observation["position"], axis=0)) - 0.05
        assert observation["contact"][0, 1] == observation["contact"][1, 0] == expected
        assert expected == (gap <= 0.0)


def test_a_contact_function_is_asked_instead() -> None:
    always = np.array([[False, True], [True, False]])
    with pytest.raises(InvalidInputError, match="actuated body touches another one"):
        task(contact=lambda environment: always).reset(seed=0)


def test_the_scene_says_what_the_control_does() -> None:
    carousel = task()
    carousel.reset(seed=5)
    scene = carousel.scene
    assert scene.control_kind == ("displacement",) * 3
    assert scene.control_of is not None and scene.control_of.tolist() == [[True] * 3, [False] * 3]
    np.testing.assert_array_equal(scene.mass, [1.0, 2.0])
    assert scene.metadata == {"task": "carousel", "seed": 5}


def test_an_episode_ends_where_a_body_leaves_its_bounds_and_is_no_success() -> None:
    trajectory = run_episode(task(BOX_BOUNDS), Steady([0.0] * 3), 1)
    assert trajectory.steps == 20  # the box rests
    far = run_episode(task(HAND_BOUNDS, tolerance=9.0), Steady([0.02, 0.0, 0.0]), 1)
    assert far.steps < 20 and far.position[-1, 0, 0] > 0.18 >= far.position[-2, 0, 0]
    assert far.scene.metadata["success"] is False
    assert run_episode(task(tolerance=9.0), RestPolicy(), 1).scene.metadata["success"] is True


def test_success_may_be_the_environments_own_word() -> None:
    own = task(tolerance=None, success_key="done")
    ahead = run_episode(own, Steady([0.02, 0.0, 0.0]), 1)
    back = run_episode(own, Steady([-0.02, 0.0, 0.0]), 1)
    assert ahead.scene.metadata["success"] and not back.scene.metadata["success"]
    with pytest.raises(InvalidInputError, match="success_key must be one of done; found 'won'"):
        run_episode(task(tolerance=None, success_key="won"), RestPolicy(), 1)


EULER = f', euler = "{ORDER}"'


@pytest.mark.parametrize(
    ("change", "arguments", "message"),
    [
        (("state[3:6]", "state[3:5]"), {}, r"body\[1\]: position must have 3 numbers, found 2"),
        (("state[3:6]", "state[14:17]"), {}, r"must lie in observations/state\[0:16\]"),
        (("state[3:6]", "pose"), {}, "no column 'observations/pose[^']*'; there are .*/state"),
        ((EULER, ""), {}, r"body\[1\]: orientation must have 4 numbers, found 3"),
        (("orientation = [1.0, 0.0, 0.0, 0.0]", ""), {}, "hand: orientation must be known, as "),
        (('relative_to = "hand"', 'relative_to = "palm"'), {}, "must name a body .*found 'palm'"),
        (("mass = 2.0", ""), {}, "box: mass must be given, as another body's is"),
        (("radius = 0.02", ""), {}, "box needs a radius, or the task a contact function"),
        (
            ("mass = 2.0", "mass = 2.0\nbounds = [[0, 0], [1, 1]]"),
            {},
            r"bounds must have shape \(2, 3\)",
        ),
        (('{ columns = "observations/target", scale = 0.01 }', "[1, 2]"), {}, "goal must have 3 n"),
        (("dt = 0.1", ""), {}, r"the map must have \[time\] dt and a goal"),
        ((), {"tolerance": None}, "success needs a tolerance or a success_key"),
        ((), {"cost": ChainCost((0, 2), [1] * 6, [1] * 6, 1)}, "cost.chain must name bodies 0 to"),
        (("actions[0:3]", "actions[2:5]"), {}, r"'actions\[2:5\]' must lie in actions\[0:4\]"),
        (("scale = 0.02\n", "scale = [1, 1]\n"), {}, "scale must be 1 or 3 numbers, found 2"),
        (("scale = 0.02\n", "scale = 0\n"), {}, "the scale of a control must not be 0"),
        (
            ('body = "hand"', 'body = ["hand", "fist"]'),
            {},
            "must name a body with actuated .*found 'fist'",
        ),
    ],
)
def test_a_map_that_does_not_fit_is_refused_in_one_line(
    change: tuple, arguments: dict, message: str
) -> None:
    with pytest.raises(InvalidInputError, match=message) as caught:
        task(*([change] if change else []), **arguments)
    assert "\n" not in str(caught.value)
    assert "carousel" in str(caught.value) or "a map" in str(caught.value)


class Fragile(AdaptedTask):
    """The carousel, which breaks in its 55th step."""

    expert = RestPolicy

    def __init__(self) -> None:
        given = {"name": "carousel", "cost": COST, "max_steps": 20, "tolerance": 0.5}
        super().__init__(Breaking, parse_map("a map", MAP), rest=0.25, **given)


class Breaking(Carousel):
    steps = 0

    def step(self, action):
        Breaking.steps += 1
        if Breaking.steps == 55:
            raise RuntimeError("the belt\nsnapped")
        return super().step(action)


def test_an_environment_that_raises_keeps_the_trajectories_before(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x.h5"
    command = ["collect", f"{__name__}:Fragile", "--episodes", "4", "--out", str(out)]
    Breaking.steps = 0
    assert cli.run(command) == 2
    (folder,) = tmp_path.glob("*.unfinished-*")
    kept, error = capsys.readouterr().err.splitlines()[-2:]
    assert kept == f"{folder}: 2 episodes are kept; the same command continues"
    assert "carousel: the environment raised RuntimeError: the belt snapped" in error
    assert error.endswith("step 14)")
    assert cli.run(command) == 0  # it snaps once only
    assert len(read_trajectories(out)) == 4 and not list(tmp_path.glob("*.unfinished-*"))
