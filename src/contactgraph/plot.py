"""Matplotlib figures of a trajectory, a model's view of it, an evaluation and a cost."""

from dataclasses import dataclass, field
from html import escape

import numpy as np
from matplotlib.figure import Figure

from contactgraph.control import Cost, LearnedCost
from contactgraph.data import InvalidInputError, Scene, Trajectory
from contactgraph.evaluate import OpenLoopMetrics
from contactgraph.evaluate.metrics import json_key
from contactgraph.model import ContactDynamics
from contactgraph.viz import (
    ReportData,
    SceneTrajectory,
    cost_figure,
    recorded_scene,
    scene_trajectory,
)
from contactgraph.viz.cost_picture import scene_cost_figure
from contactgraph.viz.figures import (
    ERROR_STYLES,
    LEGEND,
    TEXT,
    belief_figure,
    error_figure,
    new_figure,
    parameter_figure,
    reliability_panel,
)
from contactgraph.viz.report import page
from contactgraph.viz.scene_picture import draw_scene

_HORIZONS = {"": "one step ahead", "_ahead": "at the end of the window"}
_SOURCES = {"": "contacts and motion", "_inferred": "motion alone", "_unmeasured": "nothing"}
_WINDOWS = {
    "_moving": "bodies that move, all windows",
    "_contact": "all bodies, a contact changes",
    "_free": "all bodies, no contact changes",
    "": "all bodies, all windows",
}


def scene(trajectory: Trajectory, model: ContactDynamics | None = None, step: int = -1) -> Figure:
    """The bodies in state ``step``, the ways that they have gone, and the edges.

    An edge is as thick as the model believes in it; without a model it is where contact was
    recorded.
    """
    figure = new_figure(4.8, 4.8)
    draw_scene(figure.subplots(), _drawn(trajectory, model), range(trajectory.steps + 1)[step])
    return figure


def beliefs(trajectory: Trajectory, model: ContactDynamics) -> Figure:
    """Beliefs about the edges that matter, over time; bands mark recorded contact."""
    return belief_figure(_drawn(trajectory, model))


def parameters(trajectory: Trajectory, model: ContactDynamics) -> Figure:
    """Beliefs, speeds, and the learned inverse masses, stiffnesses and dampings over time."""
    return parameter_figure(_drawn(trajectory, model))


def errors(metrics: OpenLoopMetrics) -> Figure:
    """Errors of the model and of its baselines, by kind of window."""

    def of(prediction: str, windows: str) -> list[float]:
        error = metrics.numbers.get(json_key(prediction, f"n_step_rmse{windows}_m"))
        return [] if error is None else [100.0 * error]

    return error_figure(
        {
            text: {each: of(each, windows) for each in ERROR_STYLES}
            for windows, text in _WINDOWS.items()
        },
        "error, cm",
    )


def calibration(metrics: OpenLoopMetrics) -> Figure:
    """Share of true edges against belief, by horizon and by what has corrected the beliefs.

    Raises `InvalidInputError` where the data have no labels of edges.
    """
    found = metrics.to_json()
    figure = new_figure(7.0, 3.8)
    panels = figure.subplots(1, len(_HORIZONS), sharey=True)
    for axes, (ahead, text) in zip(panels, _HORIZONS.items(), strict=True):
        bins = {
            source: np.array([each[1:] for each in table if each[0]])
            for beliefs, source in _SOURCES.items()
            if (table := found.get(f"reliability{ahead}{beliefs}"))
        }
        if not bins:
            raise InvalidInputError("calibration needs recorded contacts; the data have none")
        reliability_panel(axes, text, {name: (x[:, 0], x[:, 1]) for name, x in bins.items()})
        axes.set_xlabel("belief", **TEXT)
    panels[0].set_ylabel("share of active edges", **TEXT)
    lines, names = panels[0].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside upper center", ncols=len(names), **LEGEND)
    return figure


def cost(cost: Cost, scene: Scene | None = None) -> Figure:
    """Q and R as matrices: the nodes that the cost couples, and how strongly.

    ``scene`` names the nodes; a `LearnedCost` knows its own. Raises `InvalidInputError` where
    cost and scene do not fit.
    """
    if isinstance(cost, LearnedCost):
        return cost_figure(cost)
    if scene is None:
        raise InvalidInputError("scene must be given, for the names of the nodes; found None")
    return scene_cost_figure(cost, scene)


@dataclass(frozen=True)
class Player:
    """A page that a notebook shows; ``html`` is the whole of it, for a file."""

    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        frame = 'sandbox="allow-scripts" style="width: 100%; height: 900px; border: 0"'
        return f'<iframe srcdoc="{escape(self.html)}" {frame}></iframe>'


def episode(
    trajectory: Trajectory, model: ContactDynamics | None = None, name: str = "An episode"
) -> Player:
    """The trajectory to be watched in a notebook, with the edges of `scene`; needs no network."""
    drawn = _drawn(trajectory, model, name)
    return Player(page(ReportData(name, "", scenes=(drawn,))))


def _drawn(
    trajectory: Trajectory, model: ContactDynamics | None, name: str = ""
) -> SceneTrajectory:
    """The trajectory with the model's view of it; without one with what was recorded."""
    if model is None:
        return recorded_scene(name, trajectory)
    return scene_trajectory(model, name, trajectory)
