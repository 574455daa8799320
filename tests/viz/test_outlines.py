"""Bodies with outlines are drawn as their polygons, turned as recorded, in stills and the page."""

import json
import re
import shutil
import subprocess
from importlib.resources import files

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from synthetic_pickup import changed
from test_report_page import bare

from contactgraph.viz import ReportData, SceneTrajectory
from contactgraph.viz.report import embedded_json
from contactgraph.viz.scene_picture import draw_scene, scene_limits

BAR = np.array([[-0.3, 0.0], [0.3, 0.0], [0.3, 0.1], [-0.3, 0.1]])
STEM = np.array([[-0.05, -0.4], [0.05, -0.4], [0.05, 0.0], [-0.05, 0.0]])
FLOOR = np.array([[0.0, 1.0, -0.7], [0.6, 0.8, -0.9]])
STATE, UNKNOWN = 5, 9


@pytest.fixture
def tee(scene) -> SceneTrajectory:
    """A T that turns, a bit more than a quarter at `STATE`, before a gripper that is a disc."""
    lone = bare(scene, 2)
    angle = np.zeros((lone.steps + 1, 2, 1))
    angle[:, 1, 0] = np.linspace(3.0, 3.0 + 0.35 * lone.steps, lone.steps + 1)
    angle[UNKNOWN] = np.nan
    outlines = {"polygons": (BAR, STEM[::-1]), "polygon_of": np.array([1, 1]), "planes": FLOOR}
    return changed(lone, orientation=angle, radius=None, **outlines)


def placed(outline, place, angle):
    """[V, 2] m: an outline at a place, turned by an angle."""
    turned = (outline @ [1.0, 1.0j]) * np.exp(1j * angle)
    return place + np.stack([turned.real, turned.imag], axis=-1)


def both(scene, state, angle):
    """The corners of the T at a state, [8, 2] m, in any order."""
    outlines = [placed(each, scene.position[state, 1], angle) for each in (BAR, STEM)]
    return np.concatenate(outlines)


def same_points(first, second, tolerance=1e-9):
    apart = np.linalg.norm(first[:, None] - second, axis=-1)
    return apart.min(axis=0).max() < tolerance and apart.min(axis=1).max() < tolerance


def drawn(scene, state):
    """The corners of polygons, the circles of bodies and the lines of planes in a picture."""
    axes = Figure().add_subplot()
    draw_scene(axes, scene, state)
    artists = [one for one in axes.get_children() if one.zorder == 3]
    polygons = [one.get_xy() for one in artists if isinstance(one, Polygon)]
    circles = [one.center for one in artists if isinstance(one, Circle)]
    planes = [one.get_xy1() for one in axes.lines if hasattr(one, "get_xy1")]
    return np.array(polygons).reshape(-1, 2), circles, planes


def test_polygons_are_drawn_turned(tee):
    corners, circles, planes = drawn(tee, STATE)
    assert same_points(corners, both(tee, STATE, 3.0 + 0.35 * STATE))
    assert circles == [tuple(tee.position[STATE, 0])], "no outline is known of the gripper"
    assert np.allclose(planes, FLOOR[:, :2] * FLOOR[:, 2:])
    assert tee.radius.tolist() == [0.04, 0.04]


@pytest.mark.parametrize("recorded", [True, False])
def test_polygons_are_not_turned_where_the_orientation_is_not_known(tee, recorded):
    scene, state = (tee, UNKNOWN) if recorded else (changed(tee, orientation=None), STATE)
    assert same_points(drawn(scene, state)[0], both(scene, state, 0.0))


def test_the_picture_holds_the_outlines(tee):
    low, high = scene_limits(tee)
    inside = np.concatenate([each.reshape(-1, 2) for each in tee.trajectory.outlines_of(1)])
    assert (inside > low).all() and (inside < high).all()
    tight_low, tight_high = scene_limits(changed(tee, polygons=None, polygon_of=None))
    assert (inside < tight_low).any() or (inside > tight_high).any(), "the discs do not reach them"


def test_the_page_has_outlines_only_where_there_are_any(tee, scene):
    found = json.loads(embedded_json(ReportData("T", "x", scenes=(tee, scene))))["scenes"]
    assert found[0]["outlines"] == [[], [BAR.tolist(), STEM.tolist()]]
    assert found[0]["planes"] == FLOOR.tolist()
    assert [found[1][name] for name in ("outlines", "orientation", "planes")] == [None, None, []]


PAGE = """
const sheet = new Proxy({}, { get: () => () => {}, set: () => true });
const filled = [];
globalThis.Path2D = class { constructor(path) { filled.push(path); } };
globalThis.document = { getElementById: () => ({ textContent: TEXT }) };
SCRIPTS
const clock = { scene: payload.scenes[0], step: STEP };
Object.assign(view, { axes: clock.scene.axes, toX: (x) => x, toY: (y) => y });
drawBodies(sheet, clock.scene);
console.log(JSON.stringify({ filled, ...sceneBounds(clock.scene) }));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
@pytest.mark.parametrize(
    ("step", "angle"),
    [(0.5, 3.0 + 0.35 * 0.5), (STATE, 3.0 + 0.35 * STATE), (UNKNOWN, 0.0)],
)
def test_the_page_draws_polygons_turned(tee, step, angle):
    """The page's own scripts on a canvas that only notes what it fills, in metres."""
    wrapped = (tee.trajectory.orientation + np.pi) % (2.0 * np.pi) - np.pi
    shown = changed(tee, orientation=wrapped)
    names = ("data", "projection", "canvas", "scene_frame", "scene_bodies")
    assets = files("contactgraph.viz") / "assets"
    scripts = "\n".join((assets / f"{name}.js").read_text(encoding="utf-8") for name in names)
    text = json.dumps(embedded_json(ReportData("T", "x", scenes=(shown,))))
    values = {"TEXT": text, "SCRIPTS": scripts, "STEP": str(step)}
    page = re.sub("TEXT|SCRIPTS|STEP", lambda name: values[name[0]], PAGE)
    done = subprocess.run(["node"], input=page, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    place = tee.position[int(step) : int(np.ceil(step)) + 1, 1].mean(axis=0)
    expected = np.concatenate([placed(each, place, angle) for each in (BAR, STEM)])
    assert found["filled"], "the T is an area"
    for path in found["filled"]:
        corners = np.array(re.findall(r"[-\d.e]+", path), dtype=float).reshape(-1, 2)
        assert same_points(corners, expected, 1e-5)
    inside = np.concatenate([each.reshape(-1, 2) for each in tee.trajectory.outlines_of(1)])
    assert (inside > found["low"]).all() and (inside < found["high"]).all()
