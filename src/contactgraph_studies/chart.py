"""How every chart of the study looks, and how it is written."""

import io
import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Chart

from contactgraph.data import atomic_write
from contactgraph_studies.declared import (
    FULL_AB,
    GIM_NON_TEMP,
    GIM_TEMP,
    LITERAL,
    LITERAL_NO_GIM,
    NO_GIM,
    NO_GIM_AUG,
    NO_KL,
)
from contactgraph_studies.results import Figure

INK, SOFT, RULE = "#1d2127", "#616872", "#e2ded5"
COLOURS = {
    GIM_TEMP.name: "#1b66a8",
    GIM_NON_TEMP.name: "#7fb2dd",
    NO_GIM.name: "#cb5f12",
    NO_GIM_AUG.name: "#eca86f",
    FULL_AB.name: "#7650a3",
    NO_KL.name: "#0d8074",
    LITERAL.name: "#a5a9ae",
    LITERAL_NO_GIM.name: "#6d7278",
}
"""One colour a model, in every chart."""


def chart(width: float, height: float) -> Chart:
    """An empty chart, in inches, drawn without a display."""
    made = Chart(figsize=(width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(made)
    return made


def svg(made: Chart) -> bytes:
    """The chart as SVG; the same chart gives the same bytes."""
    text = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "contactgraph", "svg.fonttype": "path"}):
        made.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def write_chart(folder: Path, name: str, made: Chart) -> None:
    """Write ``name.png`` and ``name.svg``, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / f"{name}.svg") as temporary:
        temporary.write_bytes(svg(made))
    with atomic_write(folder / f"{name}.png") as temporary:
        made.savefig(temporary, dpi=130, format="png")


def quiet(axes: Axes, title: str = "") -> None:
    """A frame that stays in the background."""
    axes.set_title(title, fontsize=11, color=INK, loc="left")
    axes.tick_params(colors=SOFT, labelsize=9, length=3)
    axes.grid(axis="y", color=RULE, lw=0.6)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(RULE)


def bars(
    axes: Axes, groups: Sequence[str], series: Sequence[tuple[str, str, Sequence[Figure]]]
) -> None:
    """Bars side by side: for every series (name, colour) one figure a group.

    A bar is a median, its whisker the range over seeds, a dot each seed. What is not finite is a
    hatched bar to the top; what was not measured leaves its place empty.
    """
    width = 0.84 / len(series)
    finite = [
        value
        for _, _, figures in series
        for figure in figures
        for value in figure.values
        if math.isfinite(value)
    ]
    top = 1.6 * max(finite, default=1.0)
    for place, (name, colour, figures) in enumerate(series):
        offset = (place - (len(series) - 1) / 2.0) * width
        for group, figure in enumerate(figures):
            x, label = group + offset, name if group == 0 else "_"
            if not figure.known:
                axes.bar(x, 0.0, width, color=colour, label=label)
            elif math.isfinite(figure.median):
                axes.bar(x, figure.median, 0.92 * width, color=colour, label=label)
                if len(figure.values) > 1:
                    high = figure.high if math.isfinite(figure.high) else top
                    axes.plot([x, x], [figure.low, high], color=INK, lw=1.0)
            else:
                axes.bar(x, top, 0.92 * width, color="none", ec=colour, hatch="///", label=label)
                axes.text(x, top, "not finite", rotation=90, fontsize=7, color=SOFT, ha="center")
    axes.set_xticks(range(len(groups)), groups)
