"""Scenes of three degrees of freedom: the same pictures, from the side."""

import base64
import dataclasses
import itertools
import json
import re
import shutil

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from PIL import Image
from synthetic_pickup import BLOCK_SIZE, GOAL, GRASP, STEPS, changed, sweep, sweep_trajectory
from test_report_browser import pixels_of, screenshot

from contactgraph.data import read_trajectories, write_trajectories
from contactgraph.viz import ReportData, SceneTrajectory, write_animation, write_summary_figure
from contactgraph.viz.projection import projection_of
from contactgraph.viz.report import embedded_json
from contactgraph.viz.scene_picture import LINK_COLOUR, draw_scene, scene_limits
from contactgraph.viz.selection import ground_of, shown_directions

LINK = np.array([int(LINK_COLOUR[i : i + 2], 16) for i in (1, 3, 5)])


@pytest.fixture(scope="module")
def scene():
    return sweep()


def corners(middle, size):
    """[8, 3] m: all corners of a box."""
    return middle + 0.5 * np.array(list(itertools.product((-1, 1), repeat=3))) * size


def test_2d_scenes_are_not_distorted():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(5, 4, 2))
    view = projection_of(2)
    assert np.array_equal(view(points), points)
    assert np.array_equal(view.depth(points), np.zeros((5, 4)))
    (face,) = view.box_faces(np.array([1.0, 2.0]), np.array([0.4, 0.2]))
    assert sorted(map(tuple, face)) == [(0.8, 1.9), (0.8, 2.1), (1.2, 1.9), (1.2, 2.1)]


def test_3d_scenes_are_viewed_from_the_side_and_upright():
    view = projection_of(3)
    assert np.allclose(view.axes @ view.axes.T, np.eye(3))
    assert np.linalg.det(view.axes) == pytest.approx(1.0), "nothing is mirrored"
    up = view(np.array([0.0, 0.0, 1.0]))
    assert up[0] == pytest.approx(0.0) and up[1] > 0.8
    assert view(np.array([1.0, 0.0, 0.0]))[0] > 0.5, "x goes to the right"
    near, far = np.array([0.0, -1.0, 0.0]), np.array([0.0, 1.0, 0.0])
    assert view.depth(near) > view.depth(far) and view(near)[1] < view(far)[1]


def test_faces_of_a_box_are_those_turned_to_the_eye():
    view = projection_of(3)
    middle, size = np.array([0.3, -0.2, 0.1]), np.array([0.04, 0.06, 0.1])
    faces = view.box_faces(middle, size)
    shown = np.concatenate(faces)
    visible = view(corners(middle, size))
    nearest = np.argmin(view.depth(corners(middle, size)))
    assert all(np.abs(visible - point).sum(axis=1).min() < 1e-12 for point in shown)
    hidden = [k for k, p in enumerate(visible) if np.abs(shown - p).sum(axis=1).min() > 1e-9]
    assert hidden == [nearest], "all corners but the farthest one"
    for axis, face in enumerate(faces):
        x, y = face.T
        area = 0.5 * abs(np.sum(x * np.roll(y, 1) - y * np.roll(x, 1)))
        assert area == pytest.approx(abs(view.axes[2, axis]) * np.prod(size) / size[axis])
    assert np.allclose(view.half_extent(size), 0.5 * np.ptp(visible, axis=0))


def test_the_ground_is_the_table_below_everything(scene):
    ground = ground_of(scene)
    assert ground.level == pytest.approx(0.0), "where the blocks stand; the hand is never lower"
    assert ground.spacing == 0.1
    for corner in (ground.low, ground.high):
        assert np.allclose(corner / 0.1, np.round(corner / 0.1))
    for places in (scene.position, scene.link_positions, scene.goal):
        level = places[..., :2].reshape(-1, 2)
        assert (level >= ground.low).all() and (level <= ground.high).all()
    lines = ground.lines()
    assert len(lines) == np.sum(np.round((ground.high - ground.low) / 0.1)) + 2
    assert np.array_equal(lines.min(axis=(0, 1)), ground.corners().min(axis=0))


def test_boxes_arm_and_goal_are_drawn_where_they_are(scene):
    axes, state = Figure().add_subplot(), GRASP + 20
    draw_scene(axes, scene, state)
    boxes = [p.get_xy() for p in axes.get_children() if isinstance(p, Polygon) and p.zorder == 3]
    assert len(boxes) == 3 * 3, "three faces each"
    outline = np.concatenate(boxes)
    places = corners(scene.position[state, 1], BLOCK_SIZE)
    for corner in scene.projection(
        np.delete(places, scene.projection.depth(places).argmin(), axis=0)
    ):
        assert np.abs(outline - corner).sum(axis=1).min() < 1e-9
    circles = {one.center: one.radius for one in axes.get_children() if isinstance(one, Circle)}
    hand = tuple(scene.projection(scene.position[state, 0]))
    assert circles[hand] == 0.025 and 0.05 in circles.values()
    arm = scene.projection(scene.link_positions[state])
    assert any(np.array_equal(line.get_xydata(), arm) for line in axes.lines)
    low, high = scene_limits(scene)
    everything = [scene.link_positions, corners(scene.goal, 0.1), ground_of(scene).corners()]
    everything += [corners(place, BLOCK_SIZE) for place in scene.position[:, 1]]
    visible = np.concatenate([scene.projection(each).reshape(-1, 2) for each in everything])
    assert (visible > low).all() and (visible < high).all()


def test_near_bodies_cover_far_ones_and_none_covers_the_hand(scene):
    axes = Figure().add_subplot()
    draw_scene(axes, scene, 0)
    bodies = [p for p in axes.get_children() if isinstance(p, Polygon | Circle) and p.zorder == 3]
    assert isinstance(bodies[-1], Circle)
    depth = scene.projection.depth(scene.position[0, 1:])
    order = [bodies[3 * k].get_xy()[:4].mean(axis=0) for k in range(3)]
    for drawn, node in zip(order, 1 + np.argsort(depth), strict=True):
        assert np.linalg.norm(drawn - scene.projection(scene.position[0, node])) < 0.06


def test_films_and_stills(tmp_path, scene):
    film = changed(scene, dt=0.004, plan=None)
    write_animation(tmp_path / "scene.gif", film)
    with Image.open(tmp_path / "scene.gif") as picture:
        assert picture.n_frames == 11
        bones = []
        for frame in (0, 10):
            picture.seek(frame)
            pixels = np.asarray(picture.convert("RGB")).astype(int)
            bones.append(np.abs(pixels - LINK).sum(axis=-1) < 25)
    assert min(bone.sum() for bone in bones) > 800
    assert (bones[0] & ~bones[1]).sum() > 400, "the arm moves, and leaves nothing behind"
    write_summary_figure(tmp_path / "still.png", scene)
    assert (tmp_path / "still.png").stat().st_size > 20000


def test_the_page_has_all_that_is_drawn(scene):
    (found,) = json.loads(embedded_json(ReportData("Arm", "x", scenes=(scene,))))["scenes"]
    read = lambda text, *shape: np.frombuffer(base64.b64decode(text), "<f4").reshape(shape)  # noqa: E731
    assert found["dimension"] == 3
    assert np.allclose(found["axes"], scene.projection.axes)
    assert found["ground"]["spacing"] == 0.1
    assert found["box"] == [None, *[BLOCK_SIZE.tolist()] * 3]
    assert np.allclose(
        read(found["linkPositions"], STEPS + 1, found["linkPoints"], 3),
        scene.link_positions,
        atol=1e-6,
    )
    assert found["plan"]["horizon"] == 25, "25 steps ahead are few enough to draw each"
    shape = (STEPS, 26, len(found["plan"]["nodes"]), 3)
    assert np.allclose(read(found["plan"]["position"], *shape), scene.plan[:, :, :2], atol=1e-6)
    level, vertical = (read(each, STEPS, 4) for each in found["stiffness"])
    assert np.allclose(vertical, scene.stiffness[..., 2], atol=1e-5)
    assert level[:, 1].max() < 1.0 < vertical[:, 1].max(), "the table holds the block up alone"
    longer = dataclasses.replace(scene, plan=np.repeat(scene.plan, 3, axis=1))
    (found,) = json.loads(embedded_json(ReportData("Arm", "x", scenes=(longer,))))["scenes"]
    assert found["plan"]["horizon"] == 25


def test_parameters_are_shown_by_direction():
    values = np.arange(24.0).reshape(2, 4, 3)
    level, vertical = shown_directions(values)
    assert level[0, 0] == 0.5 and vertical[1, 3] == 23.0
    (mean,) = shown_directions(values[..., :2])
    assert np.array_equal(mean, level)


def test_a_stored_trajectory_is_drawn_as_recorded(tmp_path):
    recorded = sweep_trajectory(distractors=1)
    write_trajectories(tmp_path / "sweep.h5", [recorded])
    (found,) = read_trajectories(tmp_path / "sweep.h5").trajectories
    edges, belief = np.array([[0, 1]]), np.zeros((STEPS, 1))
    again = SceneTrajectory("again", found, edges, belief)
    assert np.array_equal(again.link_positions, recorded.link_positions)
    assert np.array_equal(again.box(1), BLOCK_SIZE) and again.box(0) is None
    assert again.goal_radius == 0.05 and again.goal.tolist() == GOAL
    assert again.contact[:, 0].argmax() == GRASP
    scene = dataclasses.replace(found.scene, radius=None, metadata={"goal_radius": "near"})
    bare = SceneTrajectory("bare", dataclasses.replace(found, scene=scene), edges, belief)
    assert bare.radius.tolist() == [0.02] * 3, "no thicker than a block"
    assert bare.goal_radius == 0.1
    scene = dataclasses.replace(scene, size=None)
    bare = SceneTrajectory("bare", dataclasses.replace(found, scene=scene), edges, belief)
    assert bare.radius.tolist() == [0.04] * 3 and bare.box(1) is None


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs the chromium browser")
def test_browser_draws_the_arm_and_turns_the_scene(tmp_path, scene):
    data = ReportData("Arm", "sweeps", scenes=(scene,))
    picture, said = screenshot(tmp_path, data)
    assert said == []
    assert pixels_of(picture[:, :480], LINK) > 1500
    assert pixels_of(picture[:, :480], np.array([0xCB, 0x5F, 0x12])) > 60, "the block's edges"
    (tmp_path / "turned").mkdir()
    acting = """
    const canvas = document.getElementById("scene");
    canvas.setPointerCapture = () => {};
    const send = (type, clientX, clientY) =>
      canvas.dispatchEvent(new PointerEvent(type, { clientX, clientY, bubbles: true }));
    const look = [canvas.toDataURL()];
    send("pointermove", 300, 300); // not pressed
    look.push(canvas.toDataURL());
    send("pointerdown", 200, 200);
    send("pointermove", 300, 220);
    send("pointerup", 300, 220);
    look.push(canvas.toDataURL());
    send("pointermove", 100, 100);
    look.push(canvas.toDataURL());
    const plots = document.getElementById("motion-plots");
    console.log(JSON.stringify({
      same: look.map((each) => each === look[0]),
      stays: look[3] === look[2],
      solid: plots.querySelectorAll("path.solid").length,
      dashed: plots.querySelectorAll("path.dashed").length,
      dotted: plots.querySelectorAll("path.dotted").length,
      vertical: document.querySelectorAll("#parameter-plots path.dashed").length,
      words: [...document.querySelectorAll(".in-space")].filter((each) => !each.hidden).length,
    }));
    """
    _, said = screenshot(tmp_path / "turned", data, acting)
    assert len(said) == 1, said
    found = json.loads(re.search(r"\{.*\}", said[0].replace('\\"', '"'))[0])
    assert found == {
        "same": [True, True, False, False],
        "stays": True,
        "solid": 4,
        "dashed": 4,
        "dotted": 4,
        "vertical": 6,
        "words": 3,
    }
