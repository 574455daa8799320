"""A picture of a learned cost: the nodes that it couples, and how strongly.

Left is Q in the nodes' own coordinates, in the middle in relative ones (`relative_terms`), where a
cost that ties gripper to object and object to goal has nothing off its diagonal blocks; right is R.
All of it is scaled so that the mean of R's diagonal is 1/N^2: costs are known up to that factor.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, SymLogNorm
from matplotlib.figure import Figure
from matplotlib.transforms import blended_transform_factory

from contactgraph.control import Cost, LearnedCost
from contactgraph.control.learned_cost import relative_names, relative_terms
from contactgraph.data import InvalidInputError, Scene
from contactgraph.viz.scene_picture import BODY_COLOURS, INK, RULE, SOFT

_DECADES = 2.5
"""Decades below the largest entry that the colours resolve; smaller entries are near white."""
_COLOURS = LinearSegmentedColormap.from_list("cost", [BODY_COLOURS[0], "#ffffff", BODY_COLOURS[1]])
_SIDE, _BLOCK, _CELL = 4.2, 1.3, 0.3
"""Inches: of a matrix and of a block in it, at least; of a cell that fits a number."""
_MARGIN, _TOP, _SMALL, _END = 0.72, 1.05, 0.95, 0.2
"""Inches: left of a matrix, above one, of R, to the right edge."""
_LETTER, _SMALLEST = 0.6, 5.0
"""Width of a letter against its size; smallest readable size, points."""


def cost_figure(cost: LearnedCost, expert: Cost | None = None) -> Figure:
    """The picture as a matplotlib figure.

    ``expert``: the cost that generated the demonstrations, for the same scene, drawn as a
    second row. Raises `InvalidInputError` where its shapes do not fit, or vary over time.
    """
    D, names = cost.goal.shape[0], cost.kept_nodes
    rows = [("as learned", *_of_nodes("cost", cost, cost.order, D, cost.R.shape[-2:]))]
    if expert is not None:
        rows.append(("of the expert", *_of_nodes("expert", expert, cost.order, D, cost.R.shape)))
    return _figure(rows, names, D)


def scene_cost_figure(cost: Cost, scene: Scene) -> Figure:
    """The same picture of any cost, of the nodes that it weighs in a scene.

    Raises `InvalidInputError` where its shapes do not fit the scene, or vary over time.
    """
    quadratic, D = cost.quadratic(scene.node_count), scene.dimension
    ids = quadratic.cost_node_ids
    nodes = range(scene.node_count) if ids is None else [int(node) for node in ids]
    Q, R = _of_nodes("cost", quadratic, nodes, D, quadratic.R.shape[-2:])
    return _figure([("of the cost", Q, R)], [scene.node_name[node] for node in nodes], D)


def _figure(
    rows: Sequence[tuple[str, np.ndarray, np.ndarray]], names: Sequence[str], D: int
) -> Figure:
    """A row for each name, Q and R, of nodes ``names``."""
    terms = [relative_terms(Q, D) for _, Q, _ in rows]
    matrices = [each for (_, Q, R), W in zip(rows, terms, strict=True) for each in (Q, W, R)]
    largest = max(float(np.abs(matrix).max()) for matrix in matrices)
    norm = SymLogNorm(largest * 10**-_DECADES, vmin=-largest, vmax=largest)
    side = max(_SIDE, _BLOCK * len(names))
    states, relatives, controls = _MARGIN, 2 * _MARGIN + side, 2 * _MARGIN + 2 * side + 0.45
    size = controls + _SMALL + _END, len(rows) * (_TOP + side) + 0.45
    figure = Figure(figsize=size, facecolor="white")
    for index, ((whose, Q, R), W) in enumerate(zip(rows, terms, strict=True)):
        top = index * (_TOP + side) + _TOP
        own = _panel(figure, states, top, side, side)
        _draw_state(own, side, Q, names, norm)
        _title(own, f"Q {whose}, in the nodes' own coordinates")
        relative = _panel(figure, relatives, top, side, side)
        _draw_state(relative, side, W, relative_names(names), norm)
        _title(relative, "the same in relative coordinates")
        control = _panel(figure, controls, top, _SMALL, _SMALL)
        _draw(control, _SMALL, R, norm)
        _title(control, "R")
    below = _TOP + _SMALL + 0.5
    scale = _panel(figure, controls, below, 0.16, _TOP + side - below)
    _draw_scale(figure, scale, norm, largest)
    figure.text(
        states / size[0],
        0.16 / size[1],
        "1/m², s/m², s²/m² and, for R, 1/N², of which R's diagonal has 1 on average. "
        f"Rows and columns of a block are its axes {', '.join('xyz'[:D])}.",
        color=SOFT,
        fontsize=9,
    )
    return figure


def _scaled(Q: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same cost with a mean of 1 on R's diagonal."""
    factor = 1.0 / np.mean(np.diagonal(R).astype(np.float64))
    return factor * Q.astype(np.float64), factor * R.astype(np.float64)


def _of_nodes(
    what: str, cost: Cost, nodes: Sequence[int], D: int, control_shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """A cost's Q and R of these nodes, scaled."""
    part, last = 2 * D, max(nodes)
    own = cost.quadratic(last + 1)
    Q, R = np.asarray(own.Q), np.asarray(own.R)
    if Q.ndim != 2 or len(Q) < part * (last + 1) or len(Q) % part or R.shape != control_shape:
        raise InvalidInputError(
            f"{what} must have one Q for all steps, of at least {last + 1} nodes, and R of shape "
            f"{control_shape}; found shapes {Q.shape} and {R.shape}"
        )
    kept = (part * np.asarray(nodes)[:, None] + np.arange(part)).reshape(-1)
    return _scaled(Q[np.ix_(kept, kept)], R)


def _panel(figure: Figure, left: float, top: float, across: float, down: float) -> Axes:
    """A plot; inches from the figure's left and upper edge, and its size."""
    width, height = figure.get_size_inches()
    box = left / width, 1.0 - (top + down) / height, across / width, down / height
    return figure.add_axes(box)


def _title(axes: Axes, text: str) -> None:
    """Above the names of the blocks."""
    axes.annotate(
        text,
        (0.0, 1.0),
        (0.0, 44.0),
        xycoords="axes fraction",
        textcoords="offset points",
        color=INK,
        fontsize=11,
        va="bottom",
    )


def _draw_state(
    axes: Axes, side: float, matrix: np.ndarray, blocks: Sequence[str], norm: Normalize
) -> None:
    """A matrix with as many positions as velocities in every block; ``side`` in inches."""
    _draw(axes, side, matrix, norm)
    half = len(matrix) / (2 * len(blocks))
    for index in range(1, 2 * len(blocks)):
        colour, width = (INK, 1.2) if index % 2 == 0 else (SOFT, 0.6)
        axes.axhline(index * half - 0.5, color=colour, lw=width)
        axes.axvline(index * half - 0.5, color=colour, lw=width)
    width_pt = 72 * side / len(blocks)
    for index, name in enumerate(blocks):
        size = float(np.clip(width_pt / (_LETTER * len(name)), _SMALLEST, 10.0))
        fits = round(width_pt / (_LETTER * size))
        shown = name if len(name) <= fits else name[: fits - 1] + "…"
        _label(axes, (2 * index + 1) * half - 0.5, shown, INK, size, 20.0)
        for part, kind in enumerate(("position", "velocity")):
            _label(axes, (2 * index + part + 0.5) * half - 0.5, kind, SOFT, 8.0, 6.0)


def _label(axes: Axes, at: float, text: str, colour: str, size: float, away: float) -> None:
    """Above a column and left of a row, so many points from the matrix."""
    above = axes.annotate(
        text,
        (at, 1.0),
        (0.0, away),
        xycoords=blended_transform_factory(axes.transData, axes.transAxes),
        textcoords="offset points",
        ha="center",
        va="bottom",
    )
    beside = axes.annotate(
        text,
        (0.0, at),
        (-away, 0.0),
        xycoords=blended_transform_factory(axes.transAxes, axes.transData),
        textcoords="offset points",
        ha="right",
        va="center",
        rotation=90,
    )
    for label in (above, beside):
        label.set(color=colour, fontsize=size, parse_math=False)


def _draw(axes: Axes, side: float, matrix: np.ndarray, norm: Normalize) -> None:
    axes.imshow(matrix, cmap=_COLOURS, norm=norm)
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color(INK)
        spine.set_linewidth(1.2)
    cell = side / len(matrix)
    if cell < _CELL:
        return
    for (row, column), value in np.ndenumerate(matrix):
        depth = 2.0 * abs(float(norm(value)) - 0.5)
        axes.text(
            column,
            row,
            _short(value),
            color="white" if depth > 0.72 else INK if depth > 0.1 else SOFT,
            fontsize=min(8.0, 17.0 * cell),
            ha="center",
            va="center",
        )


def _short(value: float) -> str:
    """At least two digits and all before the point; empty for values near zero."""
    size = abs(value)
    if size < 0.005:
        return ""
    digits = 0 if size >= 9.95 else 1 if size >= 0.995 else 2
    return f"{value:.{digits}f}".replace("-", "\N{MINUS SIGN}")


def _draw_scale(figure: Figure, axes: Axes, norm: Normalize, largest: float) -> None:
    """The colour scale."""
    last = int(np.floor(np.log10(largest)))
    powers = [10.0**power for power in range(last - int(_DECADES) + 1, last + 1)]
    ticks = [*(-power for power in reversed(powers)), 0.0, *powers]
    labels = [f"{tick:g}".replace("-", "\N{MINUS SIGN}") for tick in ticks]
    bar = figure.colorbar(ScalarMappable(norm, _COLOURS), cax=axes)
    bar.set_ticks(ticks, labels=labels, minor=False)
    bar.minorticks_off()
    bar.outline.set_edgecolor(RULE)
    bar.ax.tick_params(colors=SOFT, labelsize=8, length=3)
