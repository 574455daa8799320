"""Style and output of a study's figures."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from contactgraph.data import (
    atomic_write,
    pair_indices,
    read_trajectories,
    with_edge_labels,
)
from contactgraph.model import ContactSensor, motion_noise
from contactgraph.model.filter import filter_trajectory, trajectory_for
from contactgraph.model.io import load_model
from contactgraph.viz import SceneTrajectory, scene_trajectory, write_summary_figure
from contactgraph.viz.figures import LEGEND, TEXT, new_figure
from contactgraph.viz.scene_picture import CONTACT_COLOUR, INK
from contactgraph.viz.summary_figure import style_axes
from contactgraph_studies.study import Picture

_FOLDER = "figures"


def panel_row(
    tasks: Sequence[Any], width: float, margin: float, height: float, share_y: bool = True
) -> tuple[Figure, list[Axes]]:
    """A figure with one panel of ``width`` inches for each task, side by side."""
    figure = new_figure(width * len(tasks) + margin, height)
    panels = list(figure.subplots(1, len(tasks), squeeze=False, sharey=share_y)[0])
    for axes, task in zip(panels, tasks, strict=True):
        axes.set_title(task.name, fontsize=11, color=INK, loc="left")
        style_axes(axes)
    return figure, panels


def svg(figure: Figure) -> bytes:
    """The figure as SVG; equal figures give equal bytes."""
    text = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "contactgraph", "svg.fonttype": "path"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def write_figure(folder: Path, name: str, title: str, caption: str, figure: Figure) -> Picture:
    """Write ``figures/NAME.svg`` and ``.png``; the figure for the page."""
    path = folder / _FOLDER / name
    path.parent.mkdir(parents=True, exist_ok=True)
    image = svg(figure)
    with atomic_write(path.with_name(f"{name}.svg")) as temporary:
        temporary.write_bytes(image)
    with atomic_write(path.with_name(f"{name}.png")) as temporary:
        figure.savefig(temporary, dpi=130, format="png")
    return Picture(title, caption, image, "svg+xml")


def write_scene(folder: Path, name: str, caption: str, scene: SceneTrajectory) -> Picture:
    """Write the summary figure of an episode to ``figures/NAME.png``."""
    path = folder / _FOLDER / f"{name}.png"
    write_summary_figure(path, scene)
    return Picture(scene.name, caption, path.read_bytes(), "png")


def kept_picture(folder: Path, name: str, title: str, caption: str) -> Picture | None:
    """A figure of an earlier page, whose sources are gone; None if there is none."""
    for kind, suffix in (("svg+xml", "svg"), ("png", "png")):
        path = folder / _FOLDER / f"{name}.{suffix}"
        if path.is_file():
            return Picture(title, caption, path.read_bytes(), kind)
    return None


def first_episode(numbers: Path, model: Path, title: str) -> SceneTrajectory | None:
    """The first trajectory beside a file of numbers; None if it or the model is missing."""
    trajectories = numbers.with_suffix(".h5")
    if not (trajectories.is_file() and model.is_file()):
        return None
    return scene_trajectory(
        load_model(model).model, title, read_trajectories(trajectories).trajectories[0]
    )


def filter_figure(model: Path, data: Path) -> Figure | None:
    """Beliefs of one edge along a trajectory, with and without correction by motion.

    The edge is the one whose label changes most often in any of the trajectories, which must have
    recorded contacts. None if a file is missing.
    """
    if not (model.is_file() and data.is_file()):
        return None
    trained = load_model(model).model
    recorded = with_edge_labels(read_trajectories(data))
    pairs = pair_indices(recorded.trajectories[0].scene.node_count)
    labels = [np.asarray(each.contact)[:, pairs[:, 0], pairs[:, 1]] for each in recorded]
    changes = [np.abs(np.diff(each.astype(int), axis=0)).sum(axis=0) for each in labels]
    chosen = int(np.argmax([each.max() for each in changes]))
    edge, label = int(np.argmax(changes[chosen])), labels[chosen]
    one = trajectory_for(trained, recorded.trajectories[chosen], contacts=False)
    time = np.arange(len(label)) * recorded.dt
    figure = new_figure(8.0, 2.6)
    axes = figure.subplots()
    style_axes(axes)
    axes.fill_between(time, label[:, edge], step="pre", color=CONTACT_COLOUR, alpha=0.55, lw=0)
    lines = {
        "corrected by motion": (motion_noise(trained), "#1b66a8", "-"),
        "never corrected": (None, "#cb5f12", "--"),
    }
    for name, (noise, colour, style) in lines.items():
        found = eqx.filter_jit(filter_trajectory)(trained, one, ContactSensor(), noise)
        belief = np.asarray(found.posterior.holding)[:, edge]
        axes.step(time, belief, where="pre", color=colour, ls=style, lw=1.5, label=name)
    axes.set_xlabel("time, s", **TEXT)
    axes.set_ylabel("belief in a hold", **TEXT)
    figure.legend(loc="outside upper center", ncols=2, **LEGEND)
    return figure
