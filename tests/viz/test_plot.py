"""Figures for Python users: they show the numbers that they are given."""

from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from synthetic_pickup import pickup

from contactgraph import plot
from contactgraph.control import chain_cost
from contactgraph.data import InvalidInputError
from contactgraph.evaluate import OpenLoopMetrics
from contactgraph.viz import SceneTrajectory

BINS = [[4, 0.05, 0.0], *[[0, None, None]] * 8, [6, 0.9, 0.5]]


@pytest.fixture
def seen(scene: SceneTrajectory, monkeypatch: pytest.MonkeyPatch) -> SceneTrajectory:
    """What every model says of any trajectory: no model needs to be compiled."""
    monkeypatch.setattr(plot, "scene_trajectory", lambda *_: scene)
    return scene


def metrics(**found: Any) -> OpenLoopMetrics:
    return cast(OpenLoopMetrics, SimpleNamespace(numbers=found, to_json=lambda: found))


def heights(axes: Any) -> list[np.ndarray]:
    return [patch.get_data().values for patch in axes.patches if not patch.get_fill()]


def test_a_scene_shows_bodies_where_they_are() -> None:
    trajectory = pickup("", 1, steps=20, horizon=2).trajectory
    for step in (0, -1):
        (axes,) = plot.scene(trajectory, step=step).axes
        middles = [each.center for each in axes.patches + axes.artists if hasattr(each, "center")]
        for position in trajectory.position[step]:
            assert any(np.allclose(middle, position) for middle in middles)


def test_beliefs_and_parameters_are_those_of_the_model(seen: SceneTrajectory) -> None:
    model: Any = object()
    (axes,) = plot.beliefs(seen.trajectory, model).axes
    assert any(np.array_equal(line, seen.belief[:, 0]) for line in heights(axes))
    assert axes.get_legend_handles_labels()[1][0] == seen.edge_name(0)
    panels = plot.parameters(seen.trajectory, model).axes
    assert [each.get_ylabel() for each in panels] == [
        *("belief", "speed, m/s", "1/m, 1/kg", "k/m, 1/s²", "c/m, 1/s")
    ]
    assert seen.inverse_mass is not None
    mean = seen.inverse_mass.mean(axis=-1)
    assert any(np.array_equal(line, mean[:, 0]) for line in heights(panels[2]))


def test_errors_stand_beside_their_baselines() -> None:
    (axes,) = plot.errors(
        metrics(
            n_step_rmse_moving_m=0.001,
            n_step_rmse_moving_inferred_m=0.002,
            constant_velocity_rmse_moving_m=0.05,
            n_step_rmse_m=0.0005,
            gnn_rmse_m=None,
        )
    ).axes
    drawn = {line.get_label(): np.asarray(line.get_xdata()).tolist() for line in axes.lines}
    assert drawn["ours, contacts measured"] == pytest.approx([0.1, 0.05])
    assert drawn["ours, by motion alone"] == pytest.approx([0.2])
    assert drawn["constant velocity"] == pytest.approx([5.0])
    assert drawn["interaction network"] == []


def test_calibration_leaves_empty_bins_out() -> None:
    figure = plot.calibration(metrics(reliability=BINS, reliability_ahead=BINS))
    for axes in figure.axes:
        (line,) = (each for each in axes.lines if each.get_label() == "contacts and motion")
        assert np.allclose(line.get_xydata(), [[0.05, 0.0], [0.9, 0.5]])
    with pytest.raises(InvalidInputError, match="calibration needs recorded contacts"):
        plot.calibration(metrics(reliability=None))


def test_a_cost_names_the_nodes_that_it_weighs() -> None:
    scene = pickup("", 1, steps=5, horizon=2).trajectory.scene
    cost = chain_cost([1, 0], [3.0] * 4, [50.0] * 4, 0.01, [0.0, 0.0], scene.node_count)
    figure = plot.cost(cost, scene)
    shown = np.asarray(figure.axes[0].images[0].get_array())
    assert np.allclose(
        shown, np.asarray(cost.Q)[np.ix_([4, 5, 6, 7, 0, 1, 2, 3], [4, 5, 6, 7, 0, 1, 2, 3])] / 0.01
    )
    assert {scene.node_name[1], scene.node_name[0]} <= {t.get_text() for t in figure.axes[0].texts}
    with pytest.raises(InvalidInputError, match="scene must be given"):
        plot.cost(cost)


def test_a_notebook_shows_an_episode_in_a_frame() -> None:
    trajectory = pickup("", 1, steps=20, horizon=2).trajectory
    player = plot.episode(trajectory, name='"<both>"')
    frames: list[dict[str, str | None]] = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, given: frames.append(dict(given))  # type: ignore[method-assign]
    parser.feed(player._repr_html_())
    (frame,) = frames
    assert frame["srcdoc"] == player.html
    assert frame["sandbox"] == "allow-scripts"
    assert "&lt;both&gt;" in player.html
    assert repr(player) == "Player()"
