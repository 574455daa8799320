"""Pictures of the arm. MuJoCo loads OpenGL during its import, so each test is a process."""

import os
import subprocess
import sys

import numpy as np
import pytest

from contactgraph_franka.envs.franka_task import FrankaTask

PICTURES = """
import sys
import numpy as np
from contactgraph_franka.envs.franka_task import FrankaTask

task, blind = FrankaTask(1, render_mode="rgb_array"), FrankaTask(1)
pictures, same = [], True
for seed in (3, 4):
    task.reset(seed=seed), blind.reset(seed=seed)
    for _ in range(40):
        pictures.append(task.render())
        one, *_ = task.step(np.array([0.0, 6.0, -1.0]))
        other, *_ = blind.step(np.array([0.0, 6.0, -1.0]))
        same = same and np.array_equal(one["position"], other["position"])
task.close()
np.savez(sys.argv[1], pictures=pictures[::39], same=same)
"""

SURFACE = "v 0 0 0\nv .05 0 0\nv 0 .05 0\nv 0 0 .05\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def in_process(script, opengl, *arguments, packages=""):
    path = os.pathsep.join(filter(None, [packages, os.environ.get("PYTHONPATH")]))
    return subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "MUJOCO_GL": opengl, "DISPLAY": "", "PYTHONPATH": path},
    )


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    path = tmp_path_factory.mktemp("pictures") / "seen.npz"
    done = in_process(PICTURES, "egl", path)
    if "OpenGL" in done.stderr:
        pytest.skip(f"no OpenGL without a screen here: {done.stderr.splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return np.load(path)


def share(picture, channel):
    """Of the picture in which one colour stands out."""
    others = np.delete(picture.astype(int), channel, axis=-1).max(axis=-1)
    return (picture[..., channel] > 1.5 * others + 20).mean()


@pytest.mark.slow
def test_pictures_show_the_block_the_distractor_and_the_goal(rendered):
    for picture in rendered["pictures"]:
        assert picture.shape == (480, 640, 3) and picture.dtype == np.uint8
        for channel in range(3):
            assert 1e-4 < share(picture, channel) < 0.05
        assert 0.2 < (picture == 255).all(axis=-1).mean() < 0.9


@pytest.mark.slow
def test_pictures_follow_the_arm(rendered):
    first, last, *_ = rendered["pictures"].astype(int)
    moved = np.abs(last - first).max(axis=-1) > 30
    assert 0.01 < moved.mean() < 0.3
    assert rendered["same"], "rendering does not change the simulation"


@pytest.mark.slow
def test_the_makers_meshes_are_rendered_if_installed(rendered, tmp_path):
    package = tmp_path / "dm_robotics" / "panda"
    surfaces = package / "assets" / "panda"
    surfaces.mkdir(parents=True)
    (package / "__init__.py").touch()
    for name in (*(f"link{index}" for index in range(8)), "hand", "finger"):
        (surfaces / f"{name}.obj").write_text(SURFACE)
    done = in_process(PICTURES, "egl", tmp_path / "other.npz", packages=str(tmp_path))
    assert done.returncode == 0, done.stderr
    other = np.load(tmp_path / "other.npz")["pictures"]
    # Splinters in place of an arm: more of the white behind it.
    white = [(pictures[0] == 255).all(axis=-1).mean() for pictures in (rendered["pictures"], other)]
    assert white[1] > white[0] + 0.02
    assert share(other[0], 0) == pytest.approx(share(rendered["pictures"][0], 0), rel=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("opengl", "said"),
    [
        ("disabled", "pictures of the arm need OpenGL without a screen: set MUJOCO_GL=egl"),
        ("nonsense", "MuJoCo cannot load the OpenGL of MUJOCO_GL=nonsense: unset it"),
    ],
)
def test_without_opengl_the_error_names_the_variable(opengl, said, tmp_path):
    done = in_process(PICTURES, opengl, tmp_path / "none.npz")
    # Some versions of MuJoCo fail once more at the end, which Python reports and ignores.
    raised, *_ = done.stderr.split("Exception ignored in")
    assert done.returncode == 1 and said in raised.splitlines()[-1]


@pytest.mark.slow
def test_without_opengl_all_but_pictures_works():
    script = "from contactgraph_franka.envs.franka_task import FrankaTask as T; T().reset(seed=0)"
    assert in_process(script, "disabled").returncode == 0


def test_without_a_render_mode_nothing_is_drawn():
    task = FrankaTask()
    task.reset(seed=0)
    with pytest.warns(UserWarning, match="draws only with render_mode"):
        assert task.render() is None
