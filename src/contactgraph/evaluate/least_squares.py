"""Least squares of the whole state: a linear baseline that is fitted to recorded trajectories.

For scenes of one number of nodes, ``x_{t+1} - x_t = W [x_t, u_t, 1]``, with the positions and
velocities of all nodes in ``x``. Inputs are scaled to unit variance, and a tiny ridge keeps the
parts of ``W`` that the data do not determine at zero.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from contactgraph.data import Trajectory

_RIDGE = 1e-9
"""Relative to the number of steps."""


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """The fits, one for every number of nodes."""

    weights: dict[int, np.ndarray]
    """[2ND + U + 1, 2ND] by number of nodes; the change of the state is ``[x, u, 1] @ weights``."""

    def __call__(self, trajectory: Trajectory, steps: int) -> np.ndarray | None:
        """[S, H, N, D] m: the predictions, as a `Baseline`; None for another number of nodes."""
        weights = self.weights.get(trajectory.scene.node_count)
        if weights is None:
            return None
        starts = trajectory.steps - steps + 1
        shape = starts, *trajectory.position.shape[1:]
        state = _states(trajectory)[:starts]
        positions = []
        # A fit may have unstable modes, whose predictions overflow to infinity.
        with np.errstate(over="ignore", invalid="ignore"):
            for step in range(steps):
                control = trajectory.control[step : step + starts]
                state = state + _inputs(state, control) @ weights
                positions.append(state[:, : state.shape[1] // 2].reshape(shape))
        return np.stack(positions, axis=1)

    def missing(self, trajectories: Iterable[Trajectory]) -> str | None:
        """The reason why some of the trajectories cannot be predicted; None if all can."""
        unknown = {each.scene.node_count for each in trajectories} - self.weights.keys()
        if not unknown:
            return None
        return (
            f"no scene of the training data has {_listed(unknown)} nodes, as the test data has; "
            f"they have {_listed(self.weights)}"
        )


def fit_least_squares(trajectories: Iterable[Trajectory]) -> LeastSquares:
    """Fit every number of nodes that occurs."""
    groups = defaultdict(list)
    for each in trajectories:
        groups[each.scene.node_count].append(each)
    return LeastSquares({count: _fitted(group) for count, group in groups.items()})


def _fitted(trajectories: list[Trajectory]) -> np.ndarray:
    states = [_states(each) for each in trajectories]
    before = np.concatenate([each[:-1] for each in states])
    change = np.concatenate([np.diff(each, axis=0) for each in states])
    inputs = _inputs(before, np.concatenate([each.control for each in trajectories]))
    mean, spread = inputs.mean(axis=0), inputs.std(axis=0)
    mean[-1] = 0.0
    constant = spread == 0.0
    scaled = np.where(constant, 0.0, inputs - mean) / np.where(constant, 1.0, spread)
    scaled[:, -1] = 1.0
    # As further rows, because the normal equations would square the condition number.
    ridge = np.sqrt(_RIDGE * len(scaled)) * np.eye(scaled.shape[1])
    rows = np.concatenate([scaled, ridge])
    targets = np.concatenate([change, np.zeros((len(ridge), change.shape[1]))])
    weights = np.linalg.lstsq(rows, targets, rcond=None)[0]
    weights[:-1] /= np.where(constant, 1.0, spread)[:-1, None]
    weights[-1] -= mean[:-1] @ weights[:-1]
    return weights


def _states(trajectory: Trajectory) -> np.ndarray:
    """[T+1, 2ND] positions m, then velocities m/s."""
    count = trajectory.steps + 1
    parts = trajectory.position.reshape(count, -1), trajectory.velocity.reshape(count, -1)
    return np.concatenate(parts, axis=1)


def _inputs(state: np.ndarray, control: np.ndarray) -> np.ndarray:
    return np.concatenate([state, control, np.ones((len(state), 1))], axis=1)


def _listed(counts: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(counts)))
