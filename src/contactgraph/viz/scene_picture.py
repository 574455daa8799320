"""One moment of a run drawn with matplotlib, for animations and stills."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from contactgraph.viz.body_picture import draw_bodies, draw_shadows, draw_skeleton
from contactgraph.viz.colours import (
    BELIEF_COLOUR,
    CONTACT_COLOUR,
    GOAL_COLOUR,
    GROUND_COLOUR,
    RULE,
    body_colour,
)
from contactgraph.viz.ground import Ground, ground_of
from contactgraph.viz.scene_run import SceneRun
from contactgraph.viz.selection import involved_nodes

_FAINTEST = 0.02
"""An edge believed less than this is not drawn."""


def scene_limits(run: SceneRun) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner, m in the picture, of a square that holds everything."""
    place, reach = run.projection(run.position), run.half_picture
    lows, highs = [(place - reach).reshape(-1, 2)], [(place + reach).reshape(-1, 2)]
    if run.goal is not None:
        goal = run.projection(run.goal)[None]
        lows.append(goal - run.goal_radius)
        highs.append(goal + run.goal_radius)
    for node in range(run.node_count):
        bar = run.bar(node)
        if bar is not None:
            ends = run.projection(bar).reshape(-1, 2)
            lows.append(ends - run.radius[node])
            highs.append(ends + run.radius[node])
    if run.skeleton is not None:
        lows.append(run.projection(run.skeleton).reshape(-1, 2))
        highs.append(lows[-1])
    below = ground_of(run)
    if below is not None:
        lows.append(run.projection(below.corners()))
        highs.append(lows[-1])
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

    The belief and the contact drawn are those about the step that led to this state. In space,
    bodies stand on a grid, and what is in the air casts a shadow straight down.
    """
    low, high = scene_limits(run)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set_color(RULE)
    involved = involved_nodes(run)
    below = ground_of(run)
    if below is not None:
        _draw_ground(axes, run, below)
        draw_shadows(axes, run, state, below)
    _draw_goal(axes, run, below)
    _draw_ways(axes, run, state, involved)
    draw_skeleton(axes, run, state)
    draw_bodies(axes, run, state, involved)
    _draw_edges(axes, run, state)


def _draw_ground(axes: Axes, run: SceneRun, below: Ground) -> None:
    rim = run.projection(below.corners())
    axes.add_artist(Polygon(rim, fc=GROUND_COLOUR, ec="none", zorder=0.5))
    for line in run.projection(below.lines()):
        axes.plot(*line.T, color=RULE, lw=0.6, zorder=0.6)


def _draw_goal(axes: Axes, run: SceneRun, below: Ground | None) -> None:
    if run.goal is None:
        return
    x, y = (float(value) for value in run.projection(run.goal))
    axes.add_artist(Circle((x, y), run.goal_radius, color=GOAL_COLOUR, alpha=0.12, lw=0))
    axes.add_artist(
        Circle((x, y), run.goal_radius, fill=False, ec=GOAL_COLOUR, lw=1.0, ls=(0, (3, 3)))
    )
    if below is not None:
        foot = run.projection(below.at(run.goal[:2]))
        axes.plot([x, foot[0]], [y, foot[1]], color=GOAL_COLOUR, lw=0.8, ls=(0, (3, 3)), zorder=1)


def _draw_ways(axes: Axes, run: SceneRun, state: int, involved: list[int]) -> None:
    plan = None if run.plan is None else run.plan[min(state, run.steps - 1), 1:]
    for node in involved:
        colour = body_colour(node, involved)
        way = run.projection(run.position[:, node])
        axes.plot(*way.T, color=colour, lw=0.7, alpha=0.25)
        axes.plot(*way[: state + 1].T, color=colour, lw=1.3, alpha=0.8)
        if plan is not None:
            axes.plot(*run.projection(plan[:, node]).T, ".", color=colour, ms=2.2, alpha=0.5)


def _draw_edges(axes: Axes, run: SceneRun, state: int) -> None:
    belief = np.nan_to_num(run.belief[max(0, state - 1)])
    for edge, (first, second) in enumerate(run.edges):
        ends = run.projection(run.position[state][[first, second]])
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
