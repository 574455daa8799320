"""All windows of an open-loop evaluation, each on its own."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from contactgraph.evaluate.calibration import Calibration
from contactgraph.evaluate.edge_scores import EdgeCounts

TURNS_RAD = np.deg2rad(0.5)
"""Angle from the one at a window's start that a body must reach to count as turning."""
TURNED_OVER_RAD = np.pi / 4.0
"""Angle from the one at a window's start by which a body that has fallen has turned."""


@dataclass(frozen=True, eq=False)
class WindowPredictions:
    """The predictions of all windows from one source of beliefs."""

    squared_error: np.ndarray
    """[W, H, N] m^2: squared distance between predicted and recorded position, 0 in padding."""
    squared_angle: np.ndarray | None
    """[W, H, N] rad^2: of the angle, 0 where it is not known. None: the model predicts none."""
    turned_over: np.ndarray | None
    """[W, N] bool: whether a body has turned by more than `TURNED_OVER_RAD` since the window's
    start, at its end. None: the model predicts no angle."""
    edge_active: np.ndarray
    """[W, H, E] bool: predicted contacts of each step."""
    now: EdgeCounts
    """Beliefs about the step just made against the label of the state reached, over the steps of
    whole trajectories; empty where contacts were not recorded."""
    next_step: Calibration
    """Beliefs about the step after each state of whole trajectories, predicted from that state;
    empty where contacts were not recorded."""
    last_step: Calibration
    """The same for the last step of every window, predicted from its start."""
    mass_errors: np.ndarray | None
    """See `mass_errors`."""
    pin_gap: np.ndarray
    """[W] m: the largest `pin_gaps` in the window; NaN without pins or without angles."""


@dataclass(frozen=True, eq=False)
class OpenLoopDetail:
    """``W`` windows of ``H`` steps of all trajectories; nodes and edges padded to the largest."""

    dt: float
    """s"""
    trajectory: np.ndarray
    """[W] int: index of the window's trajectory."""
    start: np.ndarray
    """[W] int: the state it starts from."""
    exists: np.ndarray
    """[W, N] bool: False for padding."""
    moves: np.ndarray
    """[W, N] bool: whether a body that is not static gets more than `MOVES_M` away from its
    position at the start."""
    contact: np.ndarray | None
    """[W, H+1, E] bool: true contacts. None: not recorded in every trajectory."""
    edge_exists: np.ndarray
    """[W, E] bool: False for padding."""
    measured: WindowPredictions
    """By beliefs that measured contacts and, if requested, the observed motion have corrected up to
    the window's start."""
    unmeasured: WindowPredictions
    """By beliefs that nothing has corrected."""
    inferred: WindowPredictions | None
    """By beliefs that the observed motion has corrected, without measured contacts. None: not
    requested."""
    baselines: Mapping[str, np.ndarray | None]
    """[W, H, N] m^2: squared error of each baseline; None where one is not known."""
    turns: np.ndarray
    """[W, N] bool: whether a body gets more than `TURNS_RAD` away from its angle at the start."""
    turned_over: np.ndarray
    """[W, N] bool: as that of `WindowPredictions`, of what was recorded."""
    baseline_angles: Mapping[str, np.ndarray | None]
    """[W, H, N] rad^2: squared error of the angle of each baseline; None where it tells none."""

    @property
    def contact_changes(self) -> np.ndarray | None:
        """[W] bool: whether any contact begins or ends within the window. None: not recorded."""
        if self.contact is None:
            return None
        return np.any(self.contact != self.contact[:, :1], axis=(1, 2))

    def rmse(self, squared_error: np.ndarray, windows: np.ndarray | None = None) -> float | None:
        """m: root mean square of one of the errors above over nodes, steps and windows.

        ``windows``: [W] bool, or [W, N] bool to choose nodes too; default all. None where nothing
        is chosen; infinite where a prediction is not finite.
        """
        chosen = self._chosen(windows)
        count = int(chosen.sum()) * squared_error.shape[1]
        if count == 0:
            return None
        total = np.sum(squared_error.sum(axis=1, dtype=np.float64), where=chosen)
        return float(np.sqrt(total / count))

    def _chosen(self, windows: np.ndarray | None) -> np.ndarray:
        if windows is None:
            return self.exists
        return self.exists & (windows if windows.ndim == 2 else windows[:, None])
