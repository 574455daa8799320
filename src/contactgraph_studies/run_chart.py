"""What the model believes and infers through one run: the paper's figure of learned parameters."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Chart

from contactgraph.viz import SceneRun
from contactgraph.viz.scene_picture import CONTACT_COLOUR, body_colour
from contactgraph.viz.selection import focus_nodes, involved_nodes, leading_edges, shown_directions
from contactgraph_studies.chart import SOFT, chart, quiet


def run_chart(run: SceneRun) -> Chart:
    """Belief, speed, inverse mass, stiffness and damping over time; bands where contact is true.

    In space, parameters along the vertical are dashed.
    """
    speed = np.linalg.norm(run.velocity, axis=-1)[:-1]
    parameters = [
        ("1/m, 1/kg", run.inverse_mass),
        ("k/m, 1/s²", run.stiffness),
        ("c/m, 1/s", run.damping),
    ]
    shown = [("speed, m/s", [speed])]
    shown += [(name, shown_directions(each)) for name, each in parameters if each is not None]
    made = chart(7.0, 1.4 * (1 + len(shown)))
    axes = made.subplots(1 + len(shown), 1, sharex=True)
    time = np.arange(run.steps + 1) * run.dt
    for edge in leading_edges(run):
        axes[0].stairs(run.belief[:, edge], time, baseline=None, lw=1.6, label=run.edge_name(edge))
    _band(axes[0], run, time)
    quiet(axes[0])
    axes[0].set_ylabel("belief", color=SOFT, fontsize=9)
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(fontsize=8, frameon=False, loc="center right")
    involved = involved_nodes(run)
    nodes = list(dict.fromkeys([*focus_nodes(run), *involved]))[:6]
    for panel, (name, directions) in zip(axes[1:], shown, strict=True):
        for node in nodes:
            colour = body_colour(node, involved)
            for values, style in zip(directions, ("-", "--"), strict=False):
                panel.stairs(
                    values[:, node],
                    time,
                    baseline=None,
                    color=colour,
                    lw=1.4,
                    ls=style,
                    label=run.node_name[node] if style == "-" else None,
                )
        _band(panel, run, time)
        quiet(panel)
        panel.set_ylabel(name, color=SOFT, fontsize=9)
    axes[1].legend(fontsize=8, frameon=False, loc="upper right", ncols=len(nodes))
    axes[-1].set_xlabel("time, s", color=SOFT, fontsize=9)
    return made


def _band(axes: Axes, run: SceneRun, time: np.ndarray) -> None:
    """Where the first of the leading edges is in true contact."""
    leading = leading_edges(run, limit=1)
    if run.contact is None or not leading:
        return
    touching = run.contact[1:, leading[0]]
    axes.fill_between(
        time[:-1],
        0.0,
        1.0,
        where=touching,
        step="post",
        color=CONTACT_COLOUR,
        alpha=0.55,
        lw=0,
        transform=axes.get_xaxis_transform(),
        zorder=0,
    )
