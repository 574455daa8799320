"""Choices about pictures of a trajectory: its ground, edges, bodies and moments."""

from dataclasses import dataclass

import numpy as np

from contactgraph.viz.scene_trajectory import SceneTrajectory

_SPACINGS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_MOST_SQUARES = 8


@dataclass(frozen=True, eq=False)
class Ground:
    """A level rectangle of whole squares, below everything in the trajectory."""

    low: np.ndarray
    """[2] m: the corner where the first two coordinates are least."""
    high: np.ndarray
    """[2] m"""
    level: float
    """m, along the third coordinate."""
    spacing: float
    """Side of a square, m."""

    def corners(self) -> np.ndarray:
        """[4, 3] m, in turn."""
        (left, near), (right, far) = self.low, self.high
        return self.at(np.array([[left, near], [right, near], [right, far], [left, far]]))

    def lines(self) -> np.ndarray:
        """[L, 2, 3] m: both ends of every line between squares, and of the rim."""
        ends = []
        for axis in range(2):
            count = round((self.high[axis] - self.low[axis]) / self.spacing)
            for position in np.linspace(self.low[axis], self.high[axis], count + 1):
                end = np.stack([self.low, self.high])
                end[:, axis] = position
                ends.append(self.at(end))
        return np.stack(ends)

    def at(self, points_2d: np.ndarray) -> np.ndarray:
        """[..., 3] m: points of the ground at ``points_2d`` [..., 2] m."""
        return np.concatenate([points_2d, np.full((*points_2d.shape[:-1], 1), self.level)], axis=-1)


def ground_of(scene: SceneTrajectory) -> Ground | None:
    """The ground of a trajectory in space, at the lowest height of any passive body; None in 2D."""
    if scene.dimension < 3:
        return None
    bottom = scene.position[..., 2] - scene.half_size[:, 2]
    passive = bottom[:, ~scene.actuated] if not scene.actuated.all() else bottom
    points = [scene.position - scene.half_size, scene.position + scene.half_size]
    points += [each for each in (scene.link_positions, scene.goal) if each is not None]
    points_2d = np.concatenate([each[..., :2].reshape(-1, 2) for each in points])
    low, high = points_2d.min(axis=0), points_2d.max(axis=0)
    widest = float(np.max(high - low))
    spacing = next((s for s in _SPACINGS if s * _MOST_SQUARES >= widest), _SPACINGS[-1])
    # Slightly inwards: a point on a line up to rounding needs no further row of squares.
    low = spacing * np.floor(low / spacing + 1e-6)
    high = spacing * np.ceil(high / spacing - 1e-6)
    return Ground(low, np.maximum(high, low + spacing), float(passive.min()), spacing)


_WORTH_SHOWING = 0.2
_BELIEVED = 0.5
_SHOWN_EDGES = 4


def leading_edges(scene: SceneTrajectory, limit: int = _SHOWN_EDGES) -> list[int]:
    """Edges that ever matter, most important first, at most ``limit``.

    An edge matters if it is ever truly in contact or its belief ever exceeds 0.2. True contacts
    come first, then by the largest and the mean belief.
    """
    belief = np.nan_to_num(scene.belief)
    largest, mean = belief.max(axis=0), belief.mean(axis=0)
    touched = np.zeros(scene.edge_count) if scene.contact is None else scene.contact.mean(axis=0)
    order = np.lexsort((-mean, -largest, -touched))
    return [int(e) for e in order if touched[e] > 0 or largest[e] > _WORTH_SHOWING][:limit]


def focus_nodes(scene: SceneTrajectory) -> list[int]:
    """The two main bodies, an actuated one first; one body if none touch."""
    leading = leading_edges(scene, limit=1)
    if leading:
        first, second = (int(node) for node in scene.edges[leading[0]])
        swap = bool(scene.actuated[second]) and not scene.actuated[first]
        return [second, first] if swap else [first, second]
    return [int(np.argmax(scene.actuated))]


def involved_nodes(scene: SceneTrajectory) -> list[int]:
    """The focus, then every other body that is ever truly touched or long believed to be."""
    nodes = focus_nodes(scene)
    mean = np.nan_to_num(scene.belief).mean(axis=0)
    for edge in leading_edges(scene):
        if (mean[edge] > 0.05) if scene.contact is None else scene.contact[:, edge].any():
            nodes += [int(node) for node in scene.edges[edge] if int(node) not in nodes]
    return nodes


def grasp_step(scene: SceneTrajectory) -> int | None:
    """The first state in which the two bodies in focus touch: truly, or else by belief."""
    leading = leading_edges(scene, limit=1)
    if not leading:
        return None
    if scene.contact is not None and scene.contact[:, leading[0]].any():
        return int(np.argmax(scene.contact[:, leading[0]]))
    believed = scene.belief[:, leading[0]] >= _BELIEVED
    return int(np.argmax(believed)) + 1 if believed.any() else None


def shown_directions(values: np.ndarray) -> list[np.ndarray]:
    """[T, N] each: the drawn components of parameters ``values`` [T, N, D].

    In 2D the mean is drawn. In 3D gravity distinguishes the vertical, so it is drawn beside the
    mean over the level directions.
    """
    if values.shape[-1] < 3:
        return [values.mean(axis=-1)]
    return [values[..., :2].mean(axis=-1), values[..., 2]]
