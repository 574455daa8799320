"""The detector on rendered frames. MuJoCo loads OpenGL during its import, so that a process of its
own renders them."""

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception import CameraFrame, Intrinsics
from contactgraph_franka.perception.camera import pose, rotation_of
from contactgraph_franka.perception.edges import find_edges

pytest.importorskip("mujoco", reason="needs pip install 'contactgraph[mujoco]'")
pytest.importorskip("pyapriltags", reason="needs pip install 'contactgraph[robot]'")
from contactgraph_franka.perception.detector import estimate_pose
from contactgraph_franka.perception.tags import TagDetector
from contactgraph_franka.sim.blocks import tagged_block
from contactgraph_franka.sim.camera import CameraSettings
from contactgraph_franka.sim.rendered_camera import window_around

LENS = Intrinsics(900.0, 910.0, 330.0, 250.0, 640, 480)
"""Off the middle, and not square: so that a mistake of either shows."""
CAMERA = pose(
    np.array([[0.0, 0.42, -0.9075], [1.0, 0.0, 0.0], [0.0, -0.9075, -0.42]]),
    np.array([1.2, 0.02, 0.5]),
)
BLOCK = tagged_block("block", np.array([0.4, 0.0, 0.15])).tagged
COUNT = 12

RENDERED = """
import sys
from xml.etree import ElementTree
import numpy as np
from contactgraph_franka.sim.rendered_camera import RenderedCamera
from contactgraph_franka.sim.blocks import tagged_block
from contactgraph_franka.perception import Intrinsics
from contactgraph_franka.envs.arm_model import mujoco

setup = np.load(sys.argv[1])
tree = ElementTree.fromstring(
    '<mujoco><worldbody><geom type="plane" size="3 3 .1" rgba=".45 .5 .55 1"/>'
    '<light pos="0 0 3" dir="0 0 -1" directional="true"/></worldbody></mujoco>'
)
tagged_block("block", np.array([0.4, 0.0, 0.15])).append_to(tree)
# Fingers on two sides, where they are asked for.
block = tree.find("worldbody/body")
for side in (-1, 1):
    ElementTree.SubElement(
        block, "geom", type="box", size=".01 .005 .03", pos=f"0 {side * 0.026} .02", group="4",
        rgba=".3 .3 .3 1", mass="0", contype="0", conaffinity="0",
    )
model = mujoco.MjModel.from_xml_string(ElementTree.tostring(tree, encoding="unicode"))
lens = Intrinsics(*setup["lens"][:4], *map(int, setup["lens"][4:]))
held = mujoco.MjModel.from_xml_string(ElementTree.tostring(tree, encoding="unicode"))
held.geom_group[held.geom_group == 4] = 0
cameras = {
    "exact": RenderedCamera(model, setup["camera"], lens, grey_noise=0.0, depth_noise=0.0),
    "noisy": RenderedCamera(model, setup["camera"], lens, depth_noise=0.003, seed=1),
    "windows": RenderedCamera(model, setup["camera"], lens, bodies=("block",), seed=2),
    "held": RenderedCamera(held, setup["camera"], lens, seed=3),
}
made = {}
for name, camera in cameras.items():
    frames = [camera.picture(places, 0.5) for places in setup["places"]]
    assert all(frame.time == 0.5 for frame in frames)
    made[name] = [frame.image for frame in frames]
    if frames[0].depth is not None:
        made[name + "_depth"] = [frame.depth for frame in frames]
    camera.close()
np.savez(sys.argv[2], **made)
"""


def block_poses():
    rng, made = np.random.default_rng(0), []
    for number in range(COUNT):
        tilt = rotation_of(rng.normal(0.0, 0.1, 3) * (1.0, 1.0, 0.0))
        turn = tilt @ rotation_of(np.array([0.0, 0.0, 2.0 * np.pi * number / COUNT]))
        made.append(pose(turn, rng.uniform([0.35, -0.15, 0.08], [0.55, 0.15, 0.22])))
    return made


POSES = block_poses()


def as_places(place):
    """qpos of a free body."""
    x, y, z, w = Rotation.from_matrix(place[:3, :3]).as_quat()
    return [*place[:3, 3], w, x, y, z]


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    lens = [LENS.fx, LENS.fy, LENS.cx, LENS.cy, LENS.width, LENS.height]
    places = [as_places(place) for place in POSES]
    np.savez(folder / "setup.npz", lens=lens, camera=CAMERA, places=places)
    done = subprocess.run(
        [sys.executable, "-c", RENDERED, folder / "setup.npz", folder / "frames.npz"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "MUJOCO_GL": "egl", "DISPLAY": ""},
    )
    if "OpenGL" in done.stderr:
        pytest.skip(f"no OpenGL without a screen here: {done.stderr.splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return np.load(folder / "frames.npz")


def errors(images, depths=None):
    """[F, 2] m and rad of the block's pose in the base; every frame alone."""
    found = []
    for number, (image, place) in enumerate(zip(images, POSES, strict=True)):
        frame = CameraFrame(image, None if depths is None else depths[number], 0.5)
        detected = estimate_pose(frame, TagDetector([range(9)]).detect(image), BLOCK, LENS)
        if detected is None:
            found.append((np.nan, np.nan))
            continue
        apart = np.linalg.inv(place) @ CAMERA @ detected.pose
        angle = np.arccos(np.clip((np.trace(apart[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
        found.append((np.linalg.norm(apart[:3, 3]), angle))
    return np.array(found)


@pytest.mark.parametrize(
    ("kind", "depth"),
    [("exact", None), ("noisy", None), ("noisy", "noisy_depth"), ("windows", None)],
)
@pytest.mark.slow
def test_block_poses_are_accurate_to_a_millimetre(frames, kind, depth):
    off = errors(frames[kind], None if depth is None else frames[depth])
    assert np.isfinite(off).all()
    assert np.median(off[:, 0]) < 5e-4 and off[:, 0].max() < 3e-3
    assert off[:, 1].max() < np.radians(1.5)


@pytest.mark.slow
def test_a_block_between_fingers_is_detected_by_its_free_tags(frames):
    off = errors(frames["held"])
    detected = np.isfinite(off[:, 0])
    assert detected.mean() > 0.7
    assert np.median(off[detected, 0]) < 1e-3 and off[detected, 0].max() < 0.01


@pytest.mark.slow
def test_edges_agree_with_the_intrinsics(frames):
    """The half pixel, the axes, the principal point: a tag's edges, none of them by a detector."""
    across = []
    for image, place in zip(frames["exact"], POSES, strict=True):
        to_camera = np.linalg.inv(CAMERA) @ place
        for tag in BLOCK.tags:
            corners = tag.corners @ to_camera[:3, :3].T + to_camera[:3, 3]
            normal = to_camera[:3, :3] @ tag.pose[:3, 2]
            if -normal @ corners.mean(axis=0) / np.linalg.norm(corners.mean(axis=0)) < 0.6:
                continue
            exact = LENS.project(corners)
            edges = find_edges(image, exact[None])
            assert edges.found.all()
            off = edges.ends - np.stack([exact, np.roll(exact, -1, axis=0)], axis=1)
            across.append(np.einsum("ec,ec->e", off.mean(axis=1), edges.normal))
    assert len(across) > 10
    # Sides lie all ways round: a shift of the picture would show in the spread.
    assert abs(np.mean(across)) < 0.03 and np.std(across) < 0.05


@pytest.mark.slow
def test_depth_is_the_distance_along_the_axis(frames):
    for depth, place in zip(frames["exact_depth"], POSES, strict=True):
        to_camera = np.linalg.inv(CAMERA) @ place
        tag = max(BLOCK.tags, key=lambda t: -(to_camera[:3, :3] @ t.pose[:3, 2])[2])
        centre = (to_camera @ tag.pose)[:3, 3]
        column, row = np.rint(LENS.project(centre)).astype(int)
        assert depth[row, column] == pytest.approx(centre[2], abs=2e-3)
    ratio = (frames["noisy_depth"] - frames["exact_depth"]) / frames["exact_depth"] ** 2
    assert ratio.std() == pytest.approx(0.003, rel=0.1)


@pytest.mark.slow
def test_noise_has_the_configured_size(frames):
    exact, noisy = frames["exact"].astype(float), frames["noisy"].astype(float)
    inside = (exact > 20.0) & (exact < 235.0)
    assert (noisy - exact)[inside].std() == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"first_tag": 579}, "id of a tag36h11 must be 0 to 586, found 587"),
        ({"sides": np.array([0.04, 0.04, 0.05])}, "sides of block must be twice as high as wide"),
    ],
)
def test_a_block_that_cannot_be_tagged(change, said):
    with pytest.raises(InvalidInputError, match=said):
        tagged_block("block", np.zeros(3), **change)


def test_a_block_of_other_sides_has_its_tags_within_its_faces():
    sides = np.array([0.06, 0.03, 0.12])
    block = tagged_block("block", np.zeros(3), first_tag=9, sides=sides)
    assert block.body.find("geom").get("mass") == "0.83", "the mass of the paper's block"
    for tag in block.tagged.tags:
        assert (np.abs(tag.corners) < sides / 2.0 + 2e-4).all()
        out = tag.pose[:3, 2]
        assert tag.corners @ out == pytest.approx(np.abs(out) @ sides / 2.0, abs=2e-4)


def test_a_window_stays_within_the_frame_and_there_is_none_out_of_view() -> None:
    lens, pose = CameraSettings().intrinsics, CameraSettings().pose
    for across in np.linspace(-0.9, 0.9, 37):
        part = window_around(np.array([0.5, across, 0.05]), pose, lens)
        if part is not None:
            assert part.left >= 0 and part.left + part.width <= lens.width
    assert window_around(np.array([0.5, 3.0, 0.05]), pose, lens) is None
    # Behind the camera.
    assert window_around(np.array([2.0, 0.0, 0.8]), pose, lens) is None
