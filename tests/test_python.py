"""The package as a Python user meets it: its names, Gymnasium, and one line for each object."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import contactgraph.gym
from contactgraph.data import InvalidInputError
from contactgraph.envs.registry import task_names

TASKS = [name for name in gymnasium.registry if name.startswith("contactgraph/")]
STEPS = 3


def printed(code: str) -> list[str]:
    """The lines that a fresh process prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_import_is_fast_and_loads_nothing() -> None:
    code = (
        "import sys, time\n"
        "began = time.process_time()\n"
        "import contactgraph\n"
        "print(time.process_time() - began)\n"
        "print({'jax', 'numpy', 'gymnasium', 'matplotlib'} & set(sys.modules))"
    )
    seconds, loaded = printed(code)
    assert loaded == "set()"
    assert float(seconds) < 0.1


def test_no_physics_engine_is_imported_before_a_planar_task_is_made() -> None:
    code = (
        "import sys, contactgraph, contactgraph.envs, contactgraph.evaluate, contactgraph.train\n"
        "from contactgraph.envs.registry import task_names\n"
        "task = contactgraph.make('springs')\n"
        "task.reset(seed=0)\n"
        "print({'Box2D', 'pymunk'} & set(sys.modules))\n"
        "contactgraph.make('pickup').reset(seed=0)\n"
        "print(len({'Box2D', 'pymunk'} & set(sys.modules)))"
    )
    assert printed(code) == ["set()", "1"]


def test_every_name_is_what_it_says() -> None:
    from contactgraph import control, data, train

    assert sorted(dir(contactgraph)) == sorted([*contactgraph._NAMES, "__version__"])
    assert contactgraph.__all__ == sorted(contactgraph._NAMES)
    assert contactgraph.fit is train.fit
    assert contactgraph.MPC is control.MPC
    assert contactgraph.ILQR is control.ILQR
    assert contactgraph.QuadraticCost is control.QuadraticCost
    assert contactgraph.read is data.read_trajectories
    assert contactgraph.write is data.write_trajectories
    assert contactgraph.plot.__name__ == "contactgraph.plot"
    with pytest.raises(AttributeError, match="'contactgraph' has no attribute 'lode'"):
        contactgraph.lode  # noqa: B018


def test_a_task_takes_the_options_of_the_command() -> None:
    task = contactgraph.make("multi-pickup", objects=3, distractors=2)
    task.reset(seed=0)
    assert task.scene.node_count == 6
    with pytest.raises(InvalidInputError, match=r"must be one of pickup, .*found 'pick'"):
        contactgraph.make("pick")


def test_gymnasium_imports_the_tasks_by_the_module_s_name() -> None:
    name = "contactgraph.gym:contactgraph/Door-v0"
    code = f"import gymnasium; print(gymnasium.make({name!r}).spec.kwargs)"
    assert printed(code) == ["{'task': 'door'}"]


def test_every_task_is_registered() -> None:
    assert [gymnasium.spec(name).kwargs["task"] for name in TASKS] == list(task_names())


def made(name: str) -> gymnasium.Env:
    try:
        return gymnasium.make(name, render_mode="rgb_array")
    except InvalidInputError as error:
        if name.startswith(("contactgraph/Pusht", "contactgraph/Fetch")):
            pytest.skip(str(error))  # their packages are not to be had everywhere
        raise


@pytest.mark.filterwarnings(
    "error",
    # A control in newtons or metres is not scaled to [-1, 1].
    "ignore:.*recommend using a symmetric and normalized",
)
@pytest.mark.parametrize("name", TASKS)
def test_gymnasium_accepts_and_draws(name: str) -> None:
    env = made(name)
    check_env(env.unwrapped)
    env.reset(seed=0)
    first = env.render()
    env.action_space.seed(0)
    for _ in range(STEPS):
        env.step(env.action_space.sample())
    later = env.render()
    for picture in (first, later):
        assert isinstance(picture, np.ndarray)
        assert picture.dtype == np.uint8
        assert picture.shape[2] == 3
    assert np.any(np.not_equal(first, later))
    env.close()


def test_a_picture_is_of_the_scene_and_of_its_time() -> None:
    env = gymnasium.make("contactgraph/Pickup-v0", render_mode="rgb_array", distractors=2)
    assert env.metadata["render_fps"] == 20
    env.reset(seed=0)
    task = env.unwrapped
    assert task.scene.node_count == 4
    assert not task.success()
    assert task.cost_terms().chain == (0, 1)
    again = gymnasium.make("contactgraph/Pickup-v0", render_mode="rgb_array", distractors=2)
    again.reset(seed=0)
    assert np.array_equal(env.render(), again.render())
    assert gymnasium.make("contactgraph/Pickup-v0").unwrapped.render() is None


def test_environments_in_a_vector() -> None:
    envs = gymnasium.make_vec(
        "contactgraph/Sticky-v0", num_envs=2, vectorization_mode="sync", objects=2
    )
    observation, _ = envs.reset(seed=0)
    assert observation["position"].shape == (2, 3, 2)
    _, reward, *_ = envs.step(envs.action_space.sample())
    assert reward.shape == (2,)


def test_wrong_options_and_missing_packages_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvalidInputError, match="distractors must be 0 to 20, found 99"):
        gymnasium.make("contactgraph/Pickup-v0", distractors=99)
    with pytest.raises(InvalidInputError, match="render_mode must be rgb_array or None"):
        contactgraph.gym.GymnasiumTask("pickup", "ansi")
    monkeypatch.setitem(sys.modules, "gym_pusht", None)
    with pytest.raises(InvalidInputError, match=r"^[^\n]*contactgraph\[pusht\][^\n]*$"):
        gymnasium.make("contactgraph/Pusht-v0")
