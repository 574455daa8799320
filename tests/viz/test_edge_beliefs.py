"""Beliefs about one edge over time: its choice, its true states, and what the page says of it."""

import importlib
import json
from types import SimpleNamespace

import numpy as np
import pytest

from contactgraph.data import Dataset, Scene, Trajectory, pair_indices
from contactgraph.model import ContactBelief, ContactSensor
from contactgraph.viz import (
    BeliefTimeline,
    ReportData,
    belief_timeline,
    most_changed_edge,
    scene_trajectory,
)
from contactgraph.viz.edge_beliefs import EDGE_STATES
from contactgraph.viz.report import embedded_json, page

FREE, TOUCH, HOLD, CONTACT = range(4)
NAMES = ("gripper", "left", "right")
EDGES = {(int(i), int(j)): e for e, (i, j) in enumerate(pair_indices(3))}


def trajectory(states, recorded=True):
    """Three bodies, the first actuated; ``states`` {(i, j): [state of each of 6 states]}."""
    contact, holding = np.zeros((2, 6, 3, 3), dtype=bool)
    for (i, j), each in states.items():
        contact[:, i, j] = contact[:, j, i] = np.array(each) > FREE
        holding[:, i, j] = holding[:, j, i] = np.array(each) == HOLD
    scene = Scene(NAMES, ("g", "o", "o"), np.arange(3) == 0, 0.1)
    still = np.zeros((6, 3, 2))
    known = {"contact": contact, "holding": holding if recorded else None}
    return Trajectory(scene, still, still, np.zeros((5, 2)), **known)


HELD = trajectory({(0, 1): [FREE, HOLD, HOLD, HOLD, HOLD, HOLD]})
LOST = trajectory({(0, 2): [FREE, TOUCH, HOLD, HOLD, TOUCH, FREE], (1, 2): [FREE, TOUCH] * 3})


def test_the_edge_at_the_gripper_that_changes_most_often_is_chosen():
    still = trajectory({(0, 1): [HOLD] * 6})
    pushed = trajectory({(1, 2): [FREE, TOUCH] * 3})
    assert most_changed_edge(Dataset((HELD, LOST, LOST))) == (1, EDGES[0, 2])
    assert most_changed_edge(Dataset((pushed, HELD))) == (1, EDGES[0, 1]), "the driven edge first"
    assert most_changed_edge(Dataset((still, pushed))) == (1, EDGES[1, 2]), "else any other"
    assert most_changed_edge(Dataset((still,))) is None
    blind = Trajectory(HELD.scene, HELD.position, HELD.velocity, HELD.control)
    assert most_changed_edge(Dataset((HELD, blind))) is None


def timeline(truth, **belief):
    belief = {name: np.array(each) for name, each in belief.items()}
    state = {name: np.where(each > 0.5, HOLD, FREE) for name, each in belief.items()}
    return BeliefTimeline("release", "gripper and cup", 0.05, np.array(truth), belief, state)


def test_agreement_and_changes_are_counted():
    found = timeline(
        [TOUCH, HOLD, HOLD, HOLD, TOUCH, HOLD, FREE, FREE],
        motion=[0.1, 0.2, 0.9, 0.9, 0.3, 0.9, 0.8, 0.6],
        nothing=[0.0, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9, 0.1],
    )
    assert found.agreement("motion") == 5 / 8
    assert found.agreement("nothing") == 6 / 8
    # One step late is shown, unless the label has changed back by then.
    assert found.changes_shown("motion") == 3
    assert found.changes_shown("nothing") == 3
    assert found.caption == (
        "The hold begins or ends 4 times. Corrected by motion the belief is right after 62 % of "
        "the steps, by nothing after 75 %; changes that it shows within a step: 3, 3."
    )
    late = timeline([FREE, HOLD, HOLD, HOLD], one=[0, 0, 1, 1], two=[0, 0, 0, 1])
    assert (late.changes_shown("one"), late.changes_shown("two")) == (1, 0)
    assert timeline([FREE, CONTACT], nothing=[0, 1]).label_name == "contact"


@pytest.mark.parametrize("recorded", [True, False])
def test_beliefs_are_those_of_the_edge_and_of_each_correction(monkeypatch, recorded):
    """The filter is replaced by one whose types tell what it was given."""
    given = []

    def filtered(model, batch, sensor, noise):
        given.append((batch, sensor, noise))
        seen = np.nan_to_num(np.asarray(batch.contact), nan=0.25)
        touch = np.full_like(seen, 0.125 if noise else 0.0)
        types = np.stack([1.0 - 0.5 * seen - touch, touch, 0.5 * seen], axis=-1)
        return ContactBelief(types), None, None, None

    monkeypatch.setattr("contactgraph.viz.edge_beliefs.filtered_beliefs", filtered)
    path = {(0, 2): [FREE, TOUCH, HOLD, HOLD, TOUCH, FREE]}
    dataset = Dataset((HELD if recorded else trajectory({}, recorded), trajectory(path, recorded)))
    found = belief_timeline(SimpleNamespace(sensor=ContactSensor(miss=0.1)), dataset, "t", "noise")
    assert (found.name, found.edge, found.dt) == ("t", "gripper and right", 0.1)
    assert list(found.belief) == ["contacts and motion", "motion alone", "nothing"]
    assert [noise for _, _, noise in given] == ["noise", "noise", None]
    assert [sensor.reports_touch for _, sensor, _ in given] == [not recorded] * 3
    assert {sensor.miss for _, sensor, _ in given} == {0.1}
    measured, alone, nothing = found.belief.values()
    if recorded:
        assert found.truth.tolist() == [TOUCH, HOLD, HOLD, TOUCH, FREE]
        np.testing.assert_allclose(measured, [0, 0.5, 0.5, 0, 0])
        np.testing.assert_allclose(alone, 0.125)
        assert found.state["contacts and motion"].tolist() == [FREE, HOLD, HOLD, FREE, FREE]
    else:
        assert found.truth.tolist() == [CONTACT] * 4 + [FREE]
        np.testing.assert_allclose(measured, [0.625] * 4 + [0.125])
        np.testing.assert_allclose(alone, 0.25)
        assert found.state["contacts and motion"].tolist() == [CONTACT] * 4 + [FREE]
    np.testing.assert_allclose(nothing, 0.125)
    assert found.state["nothing"].tolist() == [FREE] * 5
    given.clear()
    by_contacts = belief_timeline(SimpleNamespace(), dataset, "t", None)
    assert list(by_contacts.belief) == ["contacts", "nothing"]


@pytest.mark.parametrize("recorded", [True, False])
def test_a_scene_shows_the_belief_in_its_label(monkeypatch, recorded):
    """In holding, where that is recorded: the labels then correct it, not the touches."""

    def filtered(model, batch, sensor, noise):
        types = np.broadcast_to([0.25, 0.5, 0.25], (*batch.contact.shape, 3))
        assert sensor.reports_touch is not recorded
        assert np.asarray(batch.contact)[:, EDGES[0, 2]].tolist() == (
            [0, 0, 1, 1, 0, 0] if recorded else [0, 1, 1, 1, 1, 0]
        )
        return ContactBelief(types), ContactBelief(types), None, None

    module = importlib.import_module("contactgraph.evaluate.model_diagnostics")
    monkeypatch.setattr(module, "filtered_beliefs", filtered)
    path = {(0, 2): [FREE, TOUCH, HOLD, HOLD, TOUCH, FREE]}
    scene = scene_trajectory(SimpleNamespace(local_dynamics=None), "s", trajectory(path, recorded))
    np.testing.assert_array_equal(scene.belief, np.full((5, 3), 0.25 if recorded else 0.75))


def test_the_page_holds_runs_of_states_and_scores():
    found = timeline([TOUCH, HOLD, HOLD, FREE], motion=[0.25, 0.75, 1, 0], nothing=[0, 0, 0, 0])
    found.scores.update(motion=(0.96, 0.0147), nothing=(0.5, None))
    data = ReportData("t", "s", beliefs=(found,), horizon_s=0.5)
    (sent,) = json.loads(embedded_json(data))["beliefs"]
    assert sent["title"] == "release: gripper and cup" and sent["caption"] == found.caption
    assert sent["truth"] == [["touch", 0, 1], ["hold", 1, 3], ["free", 3, 4]]
    assert [line["source"] for line in sent["lines"]] == ["motion", "nothing"]
    assert sent["lines"][0]["states"] == [["free", 0, 1], ["hold", 1, 3], ["free", 3, 4]]
    assert sent["lines"][1]["states"] == [["free", 0, 4]]
    text = page(data)
    assert 'id="belief-charts"' in text and "Error 0.5 s ahead, cm" in text
    assert '<th scope="row">motion</th><td class="figure">0.96</td><td class="figure">1.47<' in text
    assert 'id="belief-charts"' not in page(ReportData("t", "s"))
    assert EDGE_STATES.index("hold") == HOLD
