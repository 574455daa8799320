import base64
import dataclasses
import hashlib
import json
from html.parser import HTMLParser

import numpy as np
import pytest
from synthetic_pickup import changed, pickup

from contactgraph.data import InvalidInputError, Scene, Trajectory
from contactgraph.viz import (
    BeliefTimeline,
    NStepError,
    ReliabilityCurve,
    ReportData,
    ReportMetric,
    SceneTrajectory,
    write_report,
)
from contactgraph.viz.report import page

VOID = {"meta", "input", "br", "link", "img"}
LOADING = {"src", "href", "srcset", "action", "poster", "background"}
HOSTILE = "</script><img src=x onerror=alert(1)>&\"'<!--"


class Reader(HTMLParser):
    """Checks that tags close in order, and gathers attributes and scripts."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.scripts = [], [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]
        if tag == "script":
            self.scripts.append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += text


def payload(text):
    return json.loads(Reader(text).scripts[0])


def floats(text, shape):
    return np.frombuffer(base64.b64decode(text), dtype="<f4").reshape(shape)


def test_page_is_well_formed_and_loads_nothing_but_its_own_script(data):
    text = page(data)
    reader = Reader(text)
    assert reader.open == []
    assert reader.tags.count("script") == 2
    assert not [one for one in reader.attributes if one[1] in LOADING]
    assert not [one for one in reader.attributes if one[1].startswith("on")]
    for call in ("url(", "@import", "fetch(", "XMLHttpRequest", "import(", "innerHTML"):
        assert call not in text
    namespace = "http://www.w3.org/2000/svg"
    assert "://" not in text.replace(namespace, "")
    policy = next(v for tag, name, v in reader.attributes if tag == "meta" and "default-src" in v)
    assert policy.startswith("default-src 'none'")
    digest = base64.b64encode(hashlib.sha256(reader.scripts[1].encode()).digest()).decode()
    assert f"'sha256-{digest}'" in policy, "its own script, and no other"


def test_arrays_come_back_from_the_page(data, scene):
    first = payload(page(data))["scenes"][0]
    steps, nodes, edges = scene.steps, scene.node_count, scene.edge_count
    np.testing.assert_array_equal(
        floats(first["position"], (steps + 1, nodes, 2)), scene.position.astype(np.float32)
    )
    np.testing.assert_array_equal(
        floats(first["belief"], (steps, edges)), scene.belief.astype(np.float32)
    )
    (mean,) = first["inverseMass"]
    np.testing.assert_allclose(floats(mean, (steps, nodes)), scene.inverse_mass.mean(-1), atol=1e-6)
    contact = np.zeros((steps + 1, edges), dtype=bool)
    for edge, spans in enumerate(first["contact"]):
        for start, end in spans:
            contact[start:end, edge] = True
    assert scene.contact.any()
    np.testing.assert_array_equal(contact, scene.contact)
    plan = first["plan"]
    assert plan["nodes"] == [0, 1], "distractors, which no plan moves, are left out"
    np.testing.assert_array_equal(
        floats(plan["position"], (steps, 6, 2, 2)), scene.plan[:, :, :2].astype(np.float32)
    )


def test_the_page_knows_the_task_bodies(data, scene):
    first = payload(page(data))["scenes"][0]
    assert first["focus"] == [0, 1]
    assert first["leading"][0] == 0
    assert first["grasp"] == int(np.argmax(scene.contact[:, 0]))
    assert scene.contact[first["grasp"], 0]
    assert not scene.contact[first["grasp"] - 1, 0]


def test_hostile_text_stays_text(scene):
    names = tuple(f"{name}{HOSTILE}" for name in scene.node_name)
    free = np.zeros(3, int)
    both = {HOSTILE: free, f"{HOSTILE}2": free}
    hostile = changed(scene, name=HOSTILE, node_name=names, node_type=names)
    text = page(
        ReportData(
            title=HOSTILE,
            summary=HOSTILE,
            metrics=(ReportMetric(HOSTILE, 1.0, HOSTILE, (0, 1), command=HOSTILE, tile=True),),
            scenes=(hostile,),
            beliefs=(BeliefTimeline(HOSTILE, HOSTILE, 0.1, free, both, both),),
            errors=(NStepError(HOSTILE, HOSTILE, 0.01),),
            reliability=(ReliabilityCurve(HOSTILE, HOSTILE, ((3, 0.1, 0.0),), 0.1),),
            versions={HOSTILE: HOSTILE},
            remake=(HOSTILE,),
        )
    )
    reader = Reader(text)
    assert "img" not in reader.tags
    assert len(reader.scripts) == 2
    assert payload(text)["scenes"][0]["nodeName"] == list(names)
    assert payload(text)["errors"][0]["condition"] == HOSTILE


def test_reliability_is_drawn_and_tabled(scene):
    bins = ((3, 0.05, 0.0), (1, 0.95, 1.0))
    curves = (
        ReliabilityCurve("one step ahead", "contacts measured", bins, 0.0625),
        ReliabilityCurve("at the end of the window", "nothing", bins, None),
    )
    text = page(ReportData("t", "s", scenes=(scene,), reliability=curves))
    first, second = payload(text)["reliability"]
    assert first["bins"] == [[3, 0.05, 0.0], [1, 0.95, 1.0]] and first["error"] == 0.0625
    assert (second["panel"], second["error"]) == ("at the end of the window", None)
    assert 'id="reliability-charts"' in text and ">0.0625<" in text
    assert 'id="reliability-charts"' not in page(ReportData("t", "s", scenes=(scene,)))


def test_missing_and_non_finite_values_become_gaps(scene):
    belief = scene.belief.copy()
    belief[3] = np.nan
    broken = dataclasses.replace(scene, belief=belief)
    metrics = (
        ReportMetric("not measured", None, "cm"),
        ReportMetric("no number", float("nan"), "cm", (float("nan"), float("inf"))),
    )
    errors = (NStepError("3", "all", float("nan"), None, float("inf")),)
    text = page(ReportData("t", "s", metrics, (broken,), errors))
    assert "NaN" not in Reader(text).scripts[0]
    assert ">nan" not in text
    assert ">inf" not in text
    found = payload(text)
    assert found["errors"][0]["model"] is None
    assert np.isnan(floats(found["scenes"][0]["belief"], belief.shape)[3]).all()
    assert found["scenes"][0]["leading"][0] == 0


def bare(scene, nodes):
    """The first bodies alone, without contacts, parameters, plan or goal."""
    edges = np.array([[0, 1]]) if nodes > 1 else np.zeros((0, 2), dtype=int)
    static = Scene(
        scene.node_name[:nodes],
        scene.trajectory.scene.node_type[:nodes],
        scene.actuated[:nodes],
        scene.dt,
        radius=scene.radius[:nodes],
    )
    position, velocity = (
        values[:, :nodes] for values in (scene.position, scene.trajectory.velocity)
    )
    trajectory = Trajectory(static, position, velocity, np.zeros((scene.steps, 0)))
    return SceneTrajectory("bare", trajectory, edges, scene.belief[:, : len(edges)])


@pytest.mark.parametrize("nodes", [1, 2])
def test_works_without_contacts_and_parameters(scene, nodes):
    first = payload(page(ReportData("t", "s", scenes=(bare(scene, nodes),))))["scenes"][0]
    assert first["contact"] is None
    assert first["inverseMass"] is None
    assert first["focus"] == list(range(nodes))


@pytest.mark.parametrize(
    ("kinds", "size"), [(None, 2), (("force", "force"), 2), (("force", "position"), 0)]
)
def test_a_control_that_is_no_force_is_not_drawn(scene, kinds, size):
    static = dataclasses.replace(scene.trajectory.scene, control_kind=kinds)
    trajectory = dataclasses.replace(scene.trajectory, scene=static)
    shown = ReportData("t", "s", scenes=(dataclasses.replace(scene, trajectory=trajectory),))
    assert payload(page(shown))["scenes"][0]["controlSize"] == size


def test_parts_without_data_are_left_out():
    text = page(ReportData("Only a title", "and a sentence"))
    assert "<canvas" not in text
    assert "<table" not in text
    assert "<section" not in text


def test_numbers_carry_command_and_seed(data):
    text = page(data)
    assert "--distractors 10 --seed 0</code>" in text
    assert 'data-label="Seed">0</td>' in text
    assert 'data-label="Value">12.4 ms</td>' in text


def test_large_run_stays_small():
    scene = pickup("10 distractors", 10, steps=200, horizon=2)
    assert (scene.node_count, scene.edge_count) == (12, 66)
    assert len(page(ReportData("t", "s", scenes=(scene,) * 3))) < 1_000_000


def test_file_is_written_whole_and_folders_are_made(tmp_path, data):
    path = tmp_path / "report" / "index.html"
    write_report(path, data)
    assert path.read_text(encoding="utf-8") == page(data)
    assert [one.name for one in path.parent.iterdir()] == ["index.html"]
    with pytest.raises(InvalidInputError, match=r"is a folder; name a file such as index\.html"):
        write_report(tmp_path, data)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("belief", np.zeros((3, 1)), r"'3 distractors': belief must have shape \(60, 10\)"),
        ("stiffness", np.zeros((60, 5)), r"stiffness must have shape \(60, 5, 2\)"),
        ("plan", np.zeros((60, 4, 2, 2)), r"plan must have shape \(60, 4, 5, 2\)"),
        ("edges", np.full((10, 2), 5), "edges must name nodes 0 to 4"),
    ],
)
def test_wrong_shapes_are_named(scene, field, value, message):
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(scene, **{field: value})


def test_contact_is_picked_by_edge(scene):
    assert scene.contact.shape == (scene.steps + 1, 10)
    np.testing.assert_array_equal(scene.contact[:, 0], scene.trajectory.contact[:, 0, 1])
    assert scene.contact[:, 0].any() and not scene.contact[:, 1:].any()
    assert scene.edge_name(0) == "gripper and object-0"
