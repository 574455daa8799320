"""One picture of a trajectory: moments of the scene, the belief and the learned masses."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch

from contactgraph.data import atomic_write
from contactgraph.viz.scene_picture import (
    BELIEF_COLOUR,
    CONTACT_COLOUR,
    INK,
    RULE,
    SOFT,
    body_colour,
    draw_scene,
)
from contactgraph.viz.scene_trajectory import SceneTrajectory
from contactgraph.viz.selection import (
    focus_nodes,
    grasp_step,
    involved_nodes,
    leading_edges,
    shown_directions,
)

_MOMENTS = 5


def write_summary_figure(path: str | Path, scene: SceneTrajectory) -> None:
    """Write a PNG of ``scene`` atomically: five moments, the belief and 1/m over time."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        summary_figure(scene).savefig(temporary, dpi=150, format="png")


def summary_figure(scene: SceneTrajectory) -> Figure:
    """The picture as a matplotlib figure."""
    plots = 1 + (scene.inverse_mass is not None)
    figure = Figure(figsize=(11.0, 2.9 + 1.25 * plots), facecolor="white")
    heights = [2.15] + [1.0] * plots
    grid = figure.add_gridspec(
        1 + plots,
        _MOMENTS,
        height_ratios=heights,
        hspace=0.3,
        wspace=0.04,
        left=0.055,
        right=0.985,
        top=0.94,
        bottom=0.08,
    )
    axes = [figure.add_subplot(grid[row + 1, :]) for row in range(plots)]
    _draw_belief(axes[0], scene)
    if scene.inverse_mass is not None:
        _draw_inverse_mass(axes[1], scene, scene.inverse_mass)
        axes[0].tick_params(labelbottom=False)
    axes[-1].set_xlabel("time, s", color=SOFT, fontsize=9, loc="right", labelpad=1)
    for index, state in enumerate(summary_states(scene)):
        moment = figure.add_subplot(grid[0, index])
        draw_scene(moment, scene, state)
        time = state * scene.dt
        moment.set_title(f"{time:.2f} s", fontsize=10, color=INK, pad=5)
        for plot in axes:
            plot.axvline(time, color=INK, lw=0.7, alpha=0.45)
        axes[0].add_artist(_thread(moment, axes[0], time))
    return figure


def _thread(moment: Axes, plot: Axes, time: float) -> ConnectionPatch:
    """The line from a moment's picture down to its time."""
    return ConnectionPatch(
        xyA=(0.5, 0.0),
        xyB=(time, 1.0),
        coordsA=moment.transAxes,
        coordsB=plot.get_xaxis_transform(),
        color=INK,
        lw=0.7,
        alpha=0.3,
    )


def summary_states(scene: SceneTrajectory) -> list[int]:
    """Five moments: start, before, at and after the grasp, end; evenly spread without a grasp."""
    grasp = grasp_step(scene)
    if grasp is None:
        return [int(state) for state in np.linspace(0, scene.steps, _MOMENTS)]
    after = grasp + round(0.3 * (scene.steps - grasp))
    return [0, round(0.6 * grasp), grasp, after, scene.steps]


def _draw_belief(axes: Axes, scene: SceneTrajectory) -> None:
    leading = leading_edges(scene)
    for index, edge in enumerate(leading):
        belief, strength = scene.belief[:, edge], 1.0 if index == 0 else 0.4
        line: dict[str, Any] = {"color": BELIEF_COLOUR, "lw": 1.6, "alpha": strength}
        axes.stairs(belief, scene.time, baseline=None, **line)
    _style(axes, scene, "belief", (-0.06, 1.08))
    if leading:
        _note(axes, 0.7, scene.edge_name(leading[0]), BELIEF_COLOUR)


def _draw_inverse_mass(axes: Axes, scene: SceneTrajectory, inverse_mass: np.ndarray) -> None:
    involved, focus = involved_nodes(scene), focus_nodes(scene)
    directions = shown_directions(inverse_mass)
    for index, node in enumerate(focus):
        colour = body_colour(node, involved)
        for values, style in zip(directions, ("-", "--"), strict=False):
            axes.stairs(values[:, node], scene.time, baseline=None, color=colour, lw=1.6, ls=style)
        _note(axes, 0.8 - 0.17 * index, scene.node_name[node], colour)
    largest = float(np.nanmax(np.append([values[:, focus] for values in directions], 0.1)))
    _style(axes, scene, "1/m, 1/kg", (-0.06 * largest, 1.08 * largest))
    if len(directions) > 1:
        _note(axes, 0.8 - 0.17 * len(focus), "vertical: dashed", SOFT)


def _note(axes: Axes, height: float, text: str, colour: str) -> None:
    """Text at the right edge; ``height`` is a share of the plot's."""
    axes.text(
        0.99,
        height,
        text,
        color=colour,
        fontsize=9,
        ha="right",
        transform=axes.transAxes,
        parse_math=False,
    )


def _style(axes: Axes, scene: SceneTrajectory, name: str, limits: tuple[float, float]) -> None:
    axes.set(xlim=(0, scene.steps * scene.dt), ylim=limits)
    axes.set_ylabel(name, color=SOFT, fontsize=9)
    style_axes(axes)
    mark_contact(axes, scene)


def style_axes(axes: Axes) -> None:
    """A plain frame in the background."""
    axes.tick_params(colors=SOFT, labelsize=9, length=3)
    axes.grid(axis="y", color=RULE, lw=0.6)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(RULE)


def mark_contact(axes: Axes, scene: SceneTrajectory) -> None:
    """A band over the steps that lead to a state of true contact of the leading edge."""
    leading = leading_edges(scene, limit=1)
    if scene.contact is None or not leading:
        return
    axes.stairs(
        scene.contact[1:, leading[0]].astype(float),
        scene.time,
        fill=True,
        color=CONTACT_COLOUR,
        alpha=0.55,
        lw=0,
        transform=axes.get_xaxis_transform(),
        zorder=0,
    )
