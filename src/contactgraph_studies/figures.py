"""Style and output of a study's figures."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from contactgraph.data import (
    atomic_write,
    read_trajectories,
)
from contactgraph.model.io import load_model
from contactgraph.viz import SceneTrajectory, scene_trajectory, write_summary_figure
from contactgraph.viz.figures import new_figure
from contactgraph.viz.scene_picture import INK
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
