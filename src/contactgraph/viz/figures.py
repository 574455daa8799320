"""Figures of beliefs, parameters, errors and calibration."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from contactgraph.viz.scene_picture import BODY_COLOURS, INK, RULE, SOFT, body_colour
from contactgraph.viz.scene_trajectory import SceneTrajectory
from contactgraph.viz.selection import focus_nodes, involved_nodes, leading_edges, shown_directions
from contactgraph.viz.summary_figure import mark_contact, style_axes

TEXT: dict[str, Any] = {"color": SOFT, "fontsize": 9}
LEGEND: dict[str, Any] = {"fontsize": 8, "frameon": False}


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, in inches."""
    return Figure(figsize=(width, height), facecolor="white", layout="constrained")


def belief_figure(scene: SceneTrajectory) -> Figure:
    """Beliefs about the leading edges over time; bands mark true contact of the first."""
    figure = new_figure(7.0, 2.2)
    axes = figure.subplots()
    _draw_beliefs(axes, scene)
    axes.set_xlabel("time, s", **TEXT)
    return figure


def parameter_figure(scene: SceneTrajectory) -> Figure:
    """Belief, speed, inverse mass, stiffness and damping over time; bands mark true contact.

    In three dimensions parameters along the vertical are dashed.
    """
    speed = np.linalg.norm(scene.trajectory.velocity, axis=-1)[:-1]
    parameters = [
        ("1/m, 1/kg", scene.inverse_mass),
        ("k/m, 1/s²", scene.stiffness),
        ("c/m, 1/s", scene.damping),
    ]
    shown = [("speed, m/s", [speed])]
    shown += [(name, shown_directions(each)) for name, each in parameters if each is not None]
    figure = new_figure(7.0, 1.4 * (1 + len(shown)))
    axes = figure.subplots(1 + len(shown), 1, sharex=True)
    _draw_beliefs(axes[0], scene)
    for panel, (name, _) in zip(axes[1:], shown, strict=True):
        _frame(panel, scene, name)
    involved = involved_nodes(scene)
    nodes = list(dict.fromkeys([*focus_nodes(scene), *involved]))[:6]
    for panel, (_, directions) in zip(axes[1:], shown, strict=True):
        for node in nodes:
            colour, name = body_colour(node, involved), scene.node_name[node]
            for values, style in zip(directions, ("-", "--"), strict=False):
                label = name if style == "-" else None
                line: dict[str, Any] = {"color": colour, "lw": 1.4, "ls": style, "label": label}
                panel.stairs(values[:, node], scene.time, baseline=None, **line)
    axes[1].legend(**LEGEND, loc="upper right", ncols=len(nodes))
    axes[-1].set_xlabel("time, s", **TEXT)
    return figure


def _draw_beliefs(axes: Axes, scene: SceneTrajectory) -> None:
    _frame(axes, scene, "belief")
    for edge in leading_edges(scene):
        belief, name = scene.belief[:, edge], scene.edge_name(edge)
        axes.stairs(belief, scene.time, baseline=None, lw=1.6, label=name)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(**LEGEND, loc="center right")


def _frame(axes: Axes, scene: SceneTrajectory, name: str) -> None:
    mark_contact(axes, scene)
    style_axes(axes)
    axes.set_ylabel(name, **TEXT)


def reliability_panel(
    axes: Axes, title: str, curves: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> None:
    """Share of active edges against mean belief, of each curve; the diagonal is ideal."""
    style_axes(axes)
    axes.set_title(title, fontsize=9, color=INK, loc="left")
    axes.plot([0, 1], [0, 1], color=SOFT, lw=0.8)
    for (label, (belief, share)), colour in zip(curves.items(), BODY_COLOURS, strict=False):
        axes.plot(belief, share, "o-", color=colour, ms=4, lw=1.2, label=label)


ERROR_STYLES = {
    "n_step": ("ours, contacts measured", "o", "#1b66a8", "#1b66a8"),
    "n_step_inferred": ("ours, by motion alone", "o", "none", "#1b66a8"),
    "least_squares": ("least squares", "s", "none", "#7650a3"),
    "gnn": ("interaction network", "D", "none", "#cb5f12"),
    "constant_velocity": ("constant velocity", "|", SOFT, SOFT),
    "standing_still": ("standing still", "x", SOFT, SOFT),
    "frozen_contact": ("frozen contact (oracle)", "^", "none", "#0d8074"),
}
"""Label, marker, filling and edge of each prediction."""


def error_figure(
    rows: Mapping[str, Mapping[str, Sequence[float]]], label: str = "error over moving bodies, cm"
) -> Figure:
    """Errors, cm, of each row on a logarithmic axis, ours above the baselines.

    A row has the errors by the names of `ERROR_STYLES`; those that are not finite, or 0, are not
    drawn.
    """
    figure = new_figure(8.5, 1.2 + 0.36 * len(rows))
    axes = figure.subplots()
    style_axes(axes)
    axes.grid(axis="x", color=RULE, lw=0.6)
    for name, (text, marker, filling, edge) in ERROR_STYLES.items():
        aside = -0.16 if name.startswith("n_step") else 0.16
        points = [
            (value, place + aside)
            for place, errors in enumerate(rows.values())
            for value in errors.get(name, ())
            if math.isfinite(value) and value > 0.0
        ]
        x, y = zip(*points, strict=True) if points else ((), ())
        style: dict[str, Any] = {"marker": marker, "mfc": filling, "mec": edge, "ls": "", "ms": 6}
        axes.plot(x, y, **style, label=text, zorder=3)
        if points:
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")
    axes.set_yticks(range(len(rows)), list(rows), color=INK)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlabel(label, **TEXT)
    figure.legend(loc="outside upper center", ncols=4, **LEGEND)
    return figure
