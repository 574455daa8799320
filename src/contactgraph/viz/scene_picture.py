"""A scene at one moment, drawn with matplotlib. The page has its own colours, in page.css."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle, Polygon
from scipy.spatial import ConvexHull

from contactgraph.viz.scene_trajectory import SceneTrajectory
from contactgraph.viz.selection import Ground, ground_of, involved_nodes

BODY_COLOURS = ("#1b66a8", "#cb5f12", "#7650a3", "#0d8074")
OTHER_COLOUR = "#a5a9ae"
BELIEF_COLOUR = "#b81f45"
CONTACT_COLOUR = "#f3dd9a"
GOAL_COLOUR = "#2c8a5c"
GROUND_COLOUR = "#f6f4ee"
LINK_COLOUR = "#d3d6da"
INK, SOFT, RULE = "#1d2127", "#616872", "#e2ded5"


def body_colour(node: int, involved: list[int]) -> str:
    """One colour for each task body, one muted colour for distractors."""
    index = involved.index(node) if node in involved else len(BODY_COLOURS)
    return BODY_COLOURS[index] if index < len(BODY_COLOURS) else OTHER_COLOUR


_ROUND = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
_LINK_WIDTH = 0.018
"""Line width of links, in widths of the picture."""


def draw_bodies(axes: Axes, scene: SceneTrajectory, state: int, involved: list[int]) -> None:
    """Every node; far ones first, distractors first among those equally far away."""
    position = scene.position[state]
    projected, depth = scene.projection(position), scene.projection.depth(position)

    def order(node: int) -> tuple[bool, float, bool]:
        # An actuated node is never hidden by the objects that it holds.
        return bool(scene.actuated[node]), float(depth[node]), node in involved

    for node in sorted(range(scene.node_count), key=order):
        colour = body_colour(node, involved)
        width = 2.0 if scene.actuated[node] else 1.1
        outlines, bar, box = scene.trajectory.outlines_of(node), scene.bar(node), scene.box(node)
        if outlines:
            _draw_outlines(axes, [_shown(each[state], scene) for each in outlines], colour, width)
        elif bar is not None:
            _draw_bar(axes, scene.projection(bar[state]), float(scene.radius[node]), colour, width)
        elif box is not None:
            faces = scene.projection.box_faces(position[node], box)
            _draw_box(axes, faces, colour, width)
        else:
            x, y = projected[node]
            # In 2D nodes are opaque, so that trails and plans end at their outline.
            fill = _pale(colour) if scene.dimension < 3 else (*to_rgb(colour), 0.3)
            circle = Circle((x, y), scene.radius[node], fc=fill, ec=colour, lw=width, zorder=3)
            axes.add_artist(circle)


def _shown(outline: np.ndarray, scene: SceneTrajectory) -> np.ndarray:
    """[V, 2] m, the outline as it is seen."""
    if scene.dimension < 3:
        return outline
    points = scene.projection(outline)
    return np.asarray(points[ConvexHull(points).vertices])


def _pale(colour: str, share: float = 0.3) -> np.ndarray:
    return (1.0 - share) + share * np.array(to_rgb(colour))


def _draw_outlines(axes: Axes, outlines: list[np.ndarray], colour: str, width: float) -> None:
    """A union of polygons ``outlines`` [V, 2] m: rims first, so that none is seen inside."""
    for paint, line in ((colour, 2.0 * width), (_pale(colour), 0.5)):
        for each in outlines:
            axes.add_artist(Polygon(each, fc=paint, ec=paint, lw=line, joinstyle="round", zorder=3))


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
    """The visible faces, each in its own shade, so that a box looks solid."""
    for face, share in zip(faces, (0.3, 0.42, 0.2), strict=False):
        axes.add_artist(
            Polygon(face, fc=_pale(colour, share), ec=colour, lw=width, joinstyle="round", zorder=3)
        )


def draw_links(axes: Axes, scene: SceneTrajectory, state: int) -> None:
    """The links and joints of a body that is no node."""
    if scene.link_positions is None:
        return
    points = scene.projection(scene.link_positions[state])
    left, right = axes.get_xlim()
    thickness = _points(axes, _LINK_WIDTH * (right - left))
    axes.plot(
        *points.T,
        color=LINK_COLOUR,
        lw=thickness,
        solid_capstyle="round",
        solid_joinstyle="round",
        zorder=2.5,
    )
    axes.plot(*points.T, "o", color=SOFT, ms=0.45 * thickness, mew=0, zorder=2.6)


def draw_shadows(axes: Axes, scene: SceneTrajectory, state: int, below: Ground) -> None:
    """The shadow of every node on the ground, under vertical light."""
    for node in range(scene.node_count):
        middle, half = scene.position[state, node, :2], scene.half_size[node, :2]
        outline = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * half
        if scene.box(node) is None:
            outline = np.stack([np.cos(_ROUND), np.sin(_ROUND)], axis=-1) * half
        rim = scene.projection(below.at(middle + outline))
        axes.add_artist(Polygon(rim, fc=INK, ec="none", alpha=0.12, zorder=0.7))


_FAINTEST = 0.02
"""Edges with a lower belief are not drawn."""


def scene_limits(scene: SceneTrajectory) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner, m in the picture, of a square that holds everything."""
    projected, extent = scene.projection(scene.position), scene.half_picture
    lows, highs = [(projected - extent).reshape(-1, 2)], [(projected + extent).reshape(-1, 2)]
    if scene.goal is not None:
        goal = scene.projection(scene.goal)[None]
        lows.append(goal - scene.goal_radius)
        highs.append(goal + scene.goal_radius)
    for node in range(scene.node_count):
        bar = scene.bar(node)
        if bar is not None:
            ends = scene.projection(bar).reshape(-1, 2)
            lows.append(ends - scene.radius[node])
            highs.append(ends + scene.radius[node])
        for outline in scene.trajectory.outlines_of(node):
            lows.append(scene.projection(outline).reshape(-1, 2))
            highs.append(lows[-1])
    if scene.link_positions is not None:
        lows.append(scene.projection(scene.link_positions).reshape(-1, 2))
        highs.append(lows[-1])
    below = ground_of(scene)
    if below is not None:
        lows.append(scene.projection(below.corners()))
        highs.append(lows[-1])
    low, high = np.concatenate(lows), np.concatenate(highs)
    low, high = low.min(axis=0), high.max(axis=0)
    half = 0.55 * float(np.max(high - low))
    middle = (low + high) / 2.0
    return middle - half, middle + half


def draw_scene(axes: Axes, scene: SceneTrajectory, state: int) -> None:
    """The scene at state ``state`` (0 to T): goal, trails, plan, bodies and edges by belief.

    The belief and the contact drawn are those about the step that led to this state. In space,
    bodies stand on a grid, and raised bodies cast a shadow straight down.
    """
    low, high = scene_limits(scene)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set_color(RULE)
    involved = involved_nodes(scene)
    below = ground_of(scene)
    if below is not None:
        _draw_ground(axes, scene, below)
        draw_shadows(axes, scene, state, below)
    _draw_planes(axes, scene)
    _draw_goal(axes, scene, below)
    _draw_paths(axes, scene, state, involved)
    draw_links(axes, scene, state)
    draw_bodies(axes, scene, state, involved)
    _draw_edges(axes, scene, state)


def _draw_ground(axes: Axes, scene: SceneTrajectory, below: Ground) -> None:
    rim = scene.projection(below.corners())
    axes.add_artist(Polygon(rim, fc=GROUND_COLOUR, ec="none", zorder=0.5))
    for line in scene.projection(below.lines()):
        axes.plot(*line.T, color=RULE, lw=0.6, zorder=0.6)


def _draw_planes(axes: Axes, scene: SceneTrajectory) -> None:
    """A line for each plane of a scene in the plane, such as a floor or a wall."""
    planes = scene.trajectory.scene.planes
    for x, y, offset in planes if scene.dimension == 2 else ():
        foot = offset * np.array([x, y])
        axes.axline(foot, foot + np.array([-y, x]), color=SOFT, lw=1.2, zorder=1)


def _draw_goal(axes: Axes, scene: SceneTrajectory, below: Ground | None) -> None:
    if scene.goal is None:
        return
    x, y = (float(value) for value in scene.projection(scene.goal))
    axes.add_artist(Circle((x, y), scene.goal_radius, color=GOAL_COLOUR, alpha=0.12, lw=0))
    axes.add_artist(
        Circle((x, y), scene.goal_radius, fill=False, ec=GOAL_COLOUR, lw=1.0, ls=(0, (3, 3)))
    )
    if below is not None:
        foot = scene.projection(below.at(scene.goal[:2]))
        axes.plot([x, foot[0]], [y, foot[1]], color=GOAL_COLOUR, lw=0.8, ls=(0, (3, 3)), zorder=1)


def _draw_paths(axes: Axes, scene: SceneTrajectory, state: int, involved: list[int]) -> None:
    plan = None if scene.plan is None else scene.plan[min(state, scene.steps - 1), 1:]
    for node in involved:
        colour = body_colour(node, involved)
        path = scene.projection(scene.position[:, node])
        axes.plot(*path.T, color=colour, lw=0.7, alpha=0.25)
        axes.plot(*path[: state + 1].T, color=colour, lw=1.3, alpha=0.8)
        if plan is not None:
            axes.plot(*scene.projection(plan[:, node]).T, ".", color=colour, ms=2.2, alpha=0.5)


def _draw_edges(axes: Axes, scene: SceneTrajectory, state: int) -> None:
    belief = np.nan_to_num(scene.belief[max(0, state - 1)])
    for edge, (first, second) in enumerate(scene.edges):
        ends = scene.projection(scene.position[state][[first, second]])
        width = _points(axes, float(min(scene.radius[first], scene.radius[second])))
        if scene.contact is not None and scene.contact[state, edge]:
            axes.plot(*ends.T, color=CONTACT_COLOUR, lw=width, solid_capstyle="round", zorder=4)
        probability = float(np.clip(belief[edge], 0.0, 1.0))
        if probability > _FAINTEST:
            axes.plot(
                *ends.T,
                "-o",
                color=BELIEF_COLOUR,
                alpha=0.15 + 0.85 * probability,
                lw=(0.1 + 0.35 * probability) * width,
                ms=0.6 * width,
                mew=0,
                zorder=5,
            )


def _points(axes: Axes, length: float) -> float:
    """The length [m] of the scene in typographic points."""
    left, right = axes.get_xlim()
    inches = axes.bbox.transformed(axes.figure.dpi_scale_trans.inverted()).width
    return 72.0 * float(inches) * length / (right - left)
