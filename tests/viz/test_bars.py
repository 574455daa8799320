"""Bodies on hinges are drawn as bars, in every kind of picture."""

import json
import shutil

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from synthetic_pickup import changed
from test_report_browser import screenshot
from test_report_page import bare

from contactgraph.data import Scene, Trajectory
from contactgraph.viz import ReportData, SceneTrajectory
from contactgraph.viz.report import embedded_json
from contactgraph.viz.scene_picture import bar_corners, draw_scene, scene_limits

STEPS, DT = 20, 0.05
HINGES = np.array([[np.nan, np.nan], [0.0, 0.0], [1.2, 0.4]])


@pytest.fixture(scope="module")
def doors() -> SceneTrajectory:
    """A gripper that pushes a door of 1 m, beside another door."""
    angle = -1.2 + 0.04 * np.arange(STEPS + 1)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    aside = np.stack([np.sin(angle), -np.cos(angle)], axis=-1)
    position = np.stack([0.8 * along + 0.065 * aside, 0.5 * along, 0.0 * along], axis=1)
    position[:, 2] = HINGES[2] + [0.3, -0.4]
    contact = np.zeros((STEPS + 1, 3, 3), dtype=bool)
    contact[8:, 0, 1] = contact[8:, 1, 0] = True
    scene = Scene(
        ("gripper", "door", "distractor"), ("gripper", "door", "door"), np.arange(3) == 0, DT,
        anchor=HINGES, goal=np.array([0.5, 0.1]), radius=np.array([0.04, 0.025, 0.025]),
    )  # fmt: skip
    trajectory = Trajectory(
        scene, position, np.gradient(position, DT, axis=0), np.ones((STEPS, 2)), contact
    )
    edges = np.array([[0, 1], [0, 2]])
    belief = contact[1:][:, edges[:, 0], edges[:, 1]].astype(float)
    return SceneTrajectory("doors", trajectory, edges, belief)


def test_a_bar_goes_from_hinge_to_tip(doors):
    assert doors.bar(0) is None
    bar = doors.bar(1)
    assert bar.shape == (STEPS + 1, 2, 2) and not bar[:, 0].any()
    assert np.allclose(np.linalg.norm(bar[:, 1], axis=-1), 1.0)
    assert np.allclose(bar.mean(axis=1), doors.position[:, 1])
    assert np.allclose(doors.bar(2)[5], [[1.2, 0.4], [1.8, -0.4]])
    corners = bar_corners(np.zeros(2), np.array([0.0, 1.0]), 0.025)
    assert np.allclose(corners, [[-0.025, 0], [-0.025, 1], [0.025, 1], [0.025, 0]])


def test_bars_are_drawn_and_inside_the_picture(doors):
    axes = Figure().add_subplot()
    draw_scene(axes, doors, STEPS)
    bars = [one for one in axes.get_children() if isinstance(one, Polygon)]
    assert len(bars) == 2
    tips = [doors.bar(node)[STEPS, 1] for node in (1, 2)]
    for tip in tips:
        assert min(np.abs(one.get_xy() - tip).max(axis=1).min() for one in bars) < 0.026
    dots = [one.center for one in axes.get_children() if isinstance(one, Circle)]
    for hinge in HINGES[1:]:
        assert tuple(hinge) in dots
    assert doors.bar(1)[0, 1].tolist() not in [list(place) for place in dots]
    low, high = scene_limits(doors)
    ends = np.concatenate([doors.bar(node).reshape(-1, 2) for node in (1, 2)])
    assert (ends > low).all() and (ends < high).all()
    # One node's bar does not change what others are.
    draw_scene(bare_axes := Figure().add_subplot(), changed(doors, anchor=None), 0)
    assert not [one for one in bare_axes.get_children() if isinstance(one, Polygon)]


def test_the_page_knows_the_hinges(doors, scene):
    (found,) = json.loads(embedded_json(ReportData("Doors", "two", scenes=(doors,))))["scenes"]
    assert found["anchor"] == [None, [0.0, 0.0], [1.2, 0.4]]
    (found,) = json.loads(embedded_json(ReportData("One", "x", scenes=(bare(scene, 1),))))["scenes"]
    assert found["anchor"] == [None]


def orange(picture):
    """Pixels of the scene in the door's colour, also pale."""
    return int(np.sum(picture[400:760, :480, 0] - picture[400:760, :480, 2] > 40))


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs the chromium browser")
def test_browser_draws_bars(tmp_path, doors):
    picture, said = screenshot(tmp_path, ReportData("Doors", "two of them", scenes=(doors,)))
    assert said == []
    with_bars = orange(picture)
    (tmp_path / "without").mkdir()
    without = changed(doors, anchor=None)
    picture, _ = screenshot(tmp_path / "without", ReportData("Doors", "x", scenes=(without,)))
    assert with_bars > orange(picture) + 1000, "a bar of 1 m in a scene of 2 m"
