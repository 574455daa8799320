"""What a scene in space stands on, so that a picture tells height from distance."""

from dataclasses import dataclass

import numpy as np

from contactgraph.viz.scene_run import SceneRun

_SPACINGS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_MOST_SQUARES = 8


@dataclass(frozen=True, eq=False)
class Ground:
    """A level rectangle of whole squares, below everything that ever is in the scene."""

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
            for place in np.linspace(self.low[axis], self.high[axis], count + 1):
                end = np.stack([self.low, self.high])
                end[:, axis] = place
                ends.append(self.at(end))
        return np.stack(ends)

    def at(self, places: np.ndarray) -> np.ndarray:
        """[..., 3] m: points of the ground at ``places`` [..., 2] m."""
        return np.concatenate([places, np.full((*places.shape[:-1], 1), self.level)], axis=-1)


def ground_of(run: SceneRun) -> Ground | None:
    """The ground of a run in space, as high as the lowest body that nothing actuates ever is.

    None in the plane, and where nothing has a place.
    """
    if run.dimension < 3:
        return None
    bottom = run.position[..., 2] - run.half_size[:, 2]
    passive = bottom[:, ~run.actuated] if not run.actuated.all() else bottom
    points = [run.position - run.half_size, run.position + run.half_size]
    points += [each for each in (run.skeleton, run.goal) if each is not None]
    places = np.concatenate([each[..., :2].reshape(-1, 2) for each in points])
    places, heights = places[np.isfinite(places).all(axis=1)], passive[np.isfinite(passive)]
    if not (places.size and heights.size):
        return None
    low, high = places.min(axis=0), places.max(axis=0)
    widest = float(np.max(high - low))
    spacing = next((s for s in _SPACINGS if s * _MOST_SQUARES >= widest), _SPACINGS[-1])
    # A hair inwards: what lies on a line in all but rounding needs no further row of squares.
    low = spacing * np.floor(low / spacing + 1e-6)
    high = spacing * np.ceil(high / spacing - 1e-6)
    return Ground(low, np.maximum(high, low + spacing), float(heights.min()), spacing)
