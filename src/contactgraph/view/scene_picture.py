"""One moment of a run drawn with matplotlib, for animations and stills."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle, Polygon

from contactgraph.view.scene_run import SceneRun
from contactgraph.view.selection import involved_nodes

BODY_COLOURS = ("#1b66a8", "#cb5f12", "#7650a3", "#0d8074")
OTHER_COLOUR = "#a5a9ae"
BELIEF_COLOUR = "#b81f45"
CONTACT_COLOUR = "#f3dd9a"
GOAL_COLOUR = "#2c8a5c"
INK, SOFT, RULE = "#1d2127", "#616872", "#e2ded5"

_FAINTEST = 0.02
"""An edge believed less than this is not drawn."""


def body_colour(node: int, involved: list[int]) -> str:
    """A colour for each body the run is about, one quiet colour for bystanders."""
    place = involved.index(node) if node in involved else len(BODY_COLOURS)
    return BODY_COLOURS[place] if place < len(BODY_COLOURS) else OTHER_COLOUR


def scene_limits(run: SceneRun) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner, m, of a square that holds every body and the goal."""
    place, reach = run.position[..., :2], run.radius[:, None]
    lows, highs = [(place - reach).reshape(-1, 2)], [(place + reach).reshape(-1, 2)]
    if run.goal is not None:
        lows.append(run.goal[None, :2] - run.goal_radius)
        highs.append(run.goal[None, :2] + run.goal_radius)
    for node in range(run.node_count):
        bar = run.bar(node)
        if bar is not None:
            lows.append(bar.reshape(-1, 2) - run.radius[node])
            highs.append(bar.reshape(-1, 2) + run.radius[node])
    low, high = np.concatenate(lows), np.concatenate(highs)
    known = np.isfinite(low).all(axis=1)
    if not known.any():
        return -np.ones(2), np.ones(2)
    low, high = low[known].min(axis=0), high[known].max(axis=0)
    half = 0.55 * float(np.max(high - low))
    middle = (low + high) / 2.0
    return middle - half, middle + half


def draw_scene(axes: Axes, run: SceneRun, state: int) -> None:
    """The scene at state ``state`` (0 to T): goal, trails, plan, bodies and edges by belief.

    The belief and the contact drawn are those about the step that led to this state.
    """
    low, high = scene_limits(run)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set_color(RULE)
    if run.goal is not None:
        goal = (float(run.goal[0]), float(run.goal[1]))
        axes.add_artist(Circle(goal, run.goal_radius, color=GOAL_COLOUR, alpha=0.12, lw=0))
        axes.add_artist(
            Circle(goal, run.goal_radius, fill=False, ec=GOAL_COLOUR, lw=1.0, ls=(0, (3, 3)))
        )
    involved = involved_nodes(run)
    _draw_ways(axes, run, state, involved)
    _draw_bodies(axes, run, state, involved)
    _draw_edges(axes, run, state)


def _draw_ways(axes: Axes, run: SceneRun, state: int, involved: list[int]) -> None:
    plan = None if run.plan is None else run.plan[min(state, run.steps - 1), 1:]
    for node in involved:
        colour = body_colour(node, involved)
        way = run.position[: state + 1, node]
        axes.plot(*run.position[:, node, :2].T, color=colour, lw=0.7, alpha=0.25)
        axes.plot(*way[:, :2].T, color=colour, lw=1.3, alpha=0.8)
        if plan is not None:
            axes.plot(*plan[:, node, :2].T, ".", color=colour, ms=2.2, alpha=0.5)


def _draw_bodies(axes: Axes, run: SceneRun, state: int, involved: list[int]) -> None:
    for node in sorted(range(run.node_count), key=lambda one: one in involved):
        x, y = run.position[state, node, :2]
        if not np.isfinite([x, y]).all():
            continue
        colour, radius = body_colour(node, involved), float(run.radius[node])
        width = 2.0 if run.actuated[node] else 1.1
        # Opaque and pale, so that trails and plans end at the rim.
        pale = tuple(0.7 + 0.3 * np.array(to_rgb(colour)))
        bar = run.bar(node)
        if bar is None:
            axes.add_artist(Circle((x, y), radius, fc=pale, ec=colour, lw=width, zorder=3))
            continue
        hinge, tip = bar[state]
        axes.add_artist(
            Polygon(bar_corners(hinge, tip, radius), fc=pale, ec=colour, lw=width, zorder=3)
        )
        axes.add_artist(Circle((hinge[0], hinge[1]), 0.5 * radius, color=colour, zorder=3.5))


def bar_corners(hinge: np.ndarray, tip: np.ndarray, half_thickness: float) -> np.ndarray:
    """[4, 2] m: the outline of a bar between two points."""
    along = tip - hinge
    length = float(np.hypot(*along))
    aside = half_thickness * np.array([-along[1], along[0]]) / (length or 1.0)
    return np.stack([hinge + aside, tip + aside, tip - aside, hinge - aside])


def _draw_edges(axes: Axes, run: SceneRun, state: int) -> None:
    belief = np.nan_to_num(run.belief[max(0, state - 1)])
    for edge, (first, second) in enumerate(run.edges):
        ends = run.position[state][[first, second], :2]
        width = _points(axes, float(min(run.radius[first], run.radius[second])))
        if run.contact is not None and run.contact[state, edge]:
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
    """How many points on paper a length [m] in the scene takes."""
    left, right = axes.get_xlim()
    inches = axes.bbox.transformed(axes.figure.dpi_scale_trans.inverted()).width
    return 72.0 * float(inches) * length / (right - left)
