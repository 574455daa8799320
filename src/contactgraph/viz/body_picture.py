"""The bodies of a scene at one moment, drawn with matplotlib: balls, boxes, bars and an arm."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle, Polygon

from contactgraph.viz.colours import INK, SKELETON_COLOUR, SOFT, body_colour
from contactgraph.viz.ground import Ground
from contactgraph.viz.scene_run import SceneRun

_ROUND = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
_BONE = 0.018
"""Thickness of a skeleton's bones, in widths of the picture."""


def draw_bodies(axes: Axes, run: SceneRun, state: int, involved: list[int]) -> None:
    """Every node where it is; far ones first, bystanders first among those as far away."""
    place, depth = run.projection(run.position[state]), run.projection.depth(run.position[state])

    def order(node: int) -> tuple[bool, float, bool]:
        # What moves the others is never hidden by what it holds.
        return bool(run.actuated[node]), float(np.nan_to_num(depth[node])), node in involved

    for node in sorted(range(run.node_count), key=order):
        if not np.isfinite(place[node]).all():
            continue
        colour = body_colour(node, involved)
        width = 2.0 if run.actuated[node] else 1.1
        bar, box = run.bar(node), run.box(node)
        if bar is not None:
            _draw_bar(axes, run.projection(bar[state]), float(run.radius[node]), colour, width)
        elif box is not None:
            faces = run.projection.box_faces(run.position[state, node], box)
            _draw_box(axes, faces, colour, width)
        else:
            x, y = place[node]
            # In the plane nothing is behind: opaque, so that trails and plans end at the rim.
            fill = _pale(colour) if run.dimension < 3 else (*to_rgb(colour), 0.3)
            circle = Circle((x, y), run.radius[node], fc=fill, ec=colour, lw=width, zorder=3)
            axes.add_artist(circle)


def _pale(colour: str, share: float = 0.3) -> np.ndarray:
    return (1.0 - share) + share * np.array(to_rgb(colour))


def _draw_bar(
    axes: Axes, ends: np.ndarray, half_thickness: float, colour: str, width: float
) -> None:
    """A bar from its hinge, a dot, to its tip; ``ends`` [2, 2] m in the picture."""
    hinge, tip = ends
    corners = bar_corners(hinge, tip, half_thickness)
    axes.add_artist(Polygon(corners, fc=_pale(colour), ec=colour, lw=width, zorder=3))
    axes.add_artist(Circle((hinge[0], hinge[1]), 0.5 * half_thickness, color=colour, zorder=3.5))


def bar_corners(hinge: np.ndarray, tip: np.ndarray, half_thickness: float) -> np.ndarray:
    """[4, 2] m: the outline of a bar between two points."""
    along = tip - hinge
    length = float(np.hypot(*along))
    aside = half_thickness * np.array([-along[1], along[0]]) / (length or 1.0)
    return np.stack([hinge + aside, tip + aside, tip - aside, hinge - aside])


def _draw_box(axes: Axes, faces: list[np.ndarray], colour: str, width: float) -> None:
    """The faces seen, each in a shade of its own, so that a box looks solid."""
    for face, share in zip(faces, (0.3, 0.42, 0.2), strict=False):
        axes.add_artist(
            Polygon(face, fc=_pale(colour, share), ec=colour, lw=width, joinstyle="round", zorder=3)
        )


def draw_skeleton(axes: Axes, run: SceneRun, state: int) -> None:
    """The bones and joints of a body that is no node."""
    if run.skeleton is None:
        return
    points = run.projection(run.skeleton[state])
    inches = axes.bbox.transformed(axes.figure.dpi_scale_trans.inverted()).width
    thickness = 72.0 * inches * _BONE
    axes.plot(
        *points.T,
        color=SKELETON_COLOUR,
        lw=thickness,
        solid_capstyle="round",
        solid_joinstyle="round",
        zorder=2.5,
    )
    axes.plot(*points.T, "o", color=SOFT, ms=0.45 * thickness, mew=0, zorder=2.6)


def draw_shadows(axes: Axes, run: SceneRun, state: int, below: Ground) -> None:
    """Where every node is above the ground: what it would shade if light fell straight down."""
    for node in range(run.node_count):
        middle, half = run.position[state, node, :2], run.half_size[node, :2]
        outline = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * half
        if run.box(node) is None:
            outline = np.stack([np.cos(_ROUND), np.sin(_ROUND)], axis=-1) * half
        rim = run.projection(below.at(middle + outline))
        if np.isfinite(rim).all():
            axes.add_artist(Polygon(rim, fc=INK, ec="none", alpha=0.12, zorder=0.7))
