"""Style and output of a study's figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from contactgraph.data import atomic_write, read_trajectories
from contactgraph.model.io import load_model
from contactgraph.viz import SceneTrajectory, scene_trajectory
from contactgraph.viz.figures import new_figure
from contactgraph.viz.scene_picture import INK
from contactgraph.viz.summary_figure import style_axes
from contactgraph_studies.study import Picture


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


def write_figure(folder: Path, name: str, title: str, caption: str, figure: Figure) -> Picture:
    """Write ``figures/NAME.png``."""
    picture = Picture(title, caption, f"figures/{name}.png")
    (folder / picture.path).parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / picture.path) as temporary:
        figure.savefig(temporary, dpi=130, format="png")
    return picture


def first_episode(numbers: Path, model: Path, title: str) -> SceneTrajectory | None:
    """The first trajectory beside a file of numbers; None if it or the model is missing."""
    trajectories = numbers.with_suffix(".h5")
    if not (trajectories.is_file() and model.is_file()):
        return None
    return scene_trajectory(
        load_model(model).model, title, read_trajectories(trajectories).trajectories[0]
    )
