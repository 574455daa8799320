"""Recorded windows of an open-loop evaluation, and one prediction of all of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from contactgraph.evaluate.calibration import Calibration
from contactgraph.evaluate.edge_scores import EdgeCounts

TURNS_RAD = np.deg2rad(0.5)
"""Angle from the one at a window's start that a body must reach to count as turning."""
TURNED_OVER_RAD = np.pi / 4.0
"""Angle from the one at a window's start by which a body that has fallen has turned."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """One prediction of all windows, beside what was recorded; None: it has no such quantity.

    A prediction of contacts has beliefs, too. They are empty where contacts were not recorded.
    """

    squared_error: np.ndarray
    """[W, H, N] m^2: squared distance between predicted and recorded position, 0 in padding."""
    squared_angle: np.ndarray | None = None
    """[W, H, N] rad^2: of the angle, 0 where it is not recorded."""
    turned_over: np.ndarray | None = None
    """[W, N] bool: whether a body has turned by more than `TURNED_OVER_RAD` since the window's
    start, at its end."""
    pin_gap: np.ndarray | None = None
    """[W] m: the largest `pin_gaps` in the window; NaN without pins."""
    edge_active: np.ndarray | None = None
    """[W, H, E] bool: predicted contacts of each step."""
    now: EdgeCounts | None = None
    """Beliefs about the step just made against the label of the state reached, over the steps of
    whole trajectories."""
    next_step: Calibration | None = None
    """Beliefs about the step after each state of whole trajectories, predicted from that state."""
    last_step: Calibration | None = None
    """The same for the last step of every window, predicted from its start."""
    mass_errors: np.ndarray | None = None
    """See `mass_errors`."""


@dataclass(frozen=True, eq=False)
class RecordedWindows:
    """``W`` windows of ``H`` steps of all trajectories; nodes and edges padded to the largest."""

    dt: float
    """s"""
    node_types: Sequence[Sequence[str]]
    """Of every trajectory, by its index, also of those that are too short for a window."""
    trajectory: np.ndarray
    """[W] int: index of the window's trajectory."""
    start: np.ndarray
    """[W] int: the state it starts from."""
    exists: np.ndarray
    """[W, N] bool: False for padding."""
    moves: np.ndarray
    """[W, N] bool: whether a body that is not static gets more than `MOVES_M` away from its
    position at the start."""
    turns: np.ndarray
    """[W, N] bool: whether a body gets more than `TURNS_RAD` away from its angle at the start."""
    turned_over: np.ndarray
    """[W, N] bool: as that of `Prediction`, of what was recorded."""
    contact: np.ndarray | None
    """[W, H+1, E] bool: true contacts. None: not recorded in every trajectory."""
    edge_exists: np.ndarray
    """[W, E] bool: False for padding."""

    @property
    def contact_changes(self) -> np.ndarray | None:
        """[W] bool: whether any contact begins or ends within the window. None: not recorded."""
        if self.contact is None:
            return None
        return np.any(self.contact != self.contact[:, :1], axis=(1, 2))

    def rmse(self, squared_error: np.ndarray, windows: np.ndarray | None = None) -> float | None:
        """m, or rad: root mean square of a prediction's errors over nodes, steps and windows.

        ``windows``: [W] bool, or [W, N] bool to choose nodes too; default all. None where nothing
        is chosen; infinite where a prediction is not finite.
        """
        chosen = self.exists
        if windows is not None:
            chosen = chosen & (windows if windows.ndim == 2 else windows[:, None])
        count = int(chosen.sum()) * squared_error.shape[1]
        if count == 0:
            return None
        total = np.sum(squared_error.sum(axis=1, dtype=np.float64), where=chosen)
        return float(np.sqrt(total / count))
