"""Errors and contacts of every window, for plots and for further cuts."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class InferredDetail:
    """The same windows, by beliefs that the motion seen has corrected, and no measured contact."""

    squared_error: np.ndarray
    """[W, H, N] m^2"""
    edge_active: np.ndarray
    """[W, H, E] bool"""
    touch_on_time: np.ndarray
    """[touches] bool"""


@dataclass(frozen=True, eq=False)
class OpenLoopDetail:
    """``W`` windows of ``H`` steps of all runs; nodes and edges padded to the largest run.

    Squared errors are squared distances between predicted and recorded position, 0 in padding.
    """

    dt: float
    """s"""
    run: np.ndarray
    """[W] int: the window's run."""
    start: np.ndarray
    """[W] int: the state it starts from."""
    exists: np.ndarray
    """[W, N] bool: False for padding."""
    moves: np.ndarray
    """[W, N] bool: whether a node gets more than 1 mm away from where it was at the start."""
    squared_error: np.ndarray
    """[W, H, N] m^2: of the model, its beliefs corrected by measured contacts up to the start."""
    squared_error_unmeasured: np.ndarray
    """[W, H, N] m^2: of the model, without measured contacts."""
    constant_velocity: np.ndarray
    """[W, H, N] m^2: of no forces."""
    frozen_contact: np.ndarray | None
    """[W, H, N] m^2: of true masses and the contacts of the window's first state."""
    contact: np.ndarray | None
    """[W, H+1, E] bool: true contacts. None: not recorded in every run."""
    edge_active: np.ndarray
    """[W, H, E] bool: predicted contacts of each step."""
    edge_active_unmeasured: np.ndarray
    """[W, H, E] bool"""
    edge_exists: np.ndarray
    """[W, E] bool: False for padding."""
    touch_on_time: np.ndarray
    """[touches] bool: of all touches in all runs, those predicted for their very step."""
    touch_on_time_unmeasured: np.ndarray
    """[touches] bool"""
    inferred: InferredDetail | None = None
    """None: contacts were not to be inferred."""
    contact_changes: np.ndarray | None = field(init=False)
    """[W] bool: whether any contact begins or ends within the window."""

    def __post_init__(self) -> None:
        changes = None
        if self.contact is not None:
            changes = np.any(self.contact != self.contact[:, :1], axis=(1, 2))
        object.__setattr__(self, "contact_changes", changes)

    @property
    def horizon(self) -> np.ndarray:
        """[H] s: time from a window's start to each of its steps' ends."""
        return self.dt * np.arange(1, self.squared_error.shape[1] + 1)

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

    def rmse_by_step(
        self, squared_error: np.ndarray, windows: np.ndarray | None = None
    ) -> np.ndarray:
        """[H] m: the same for each step ahead, to be drawn over `horizon`; NaN where nothing is."""
        chosen = self._chosen(windows)
        if not chosen.any():
            return np.full(squared_error.shape[1], np.nan)
        total = np.sum(squared_error, axis=(0, 2), where=chosen[:, None], dtype=np.float64)
        return np.sqrt(total / int(chosen.sum()))

    def rmse_by_window(self, squared_error: np.ndarray) -> np.ndarray:
        """[W] m: over the nodes and steps of each window."""
        count = self.exists.sum(axis=1) * squared_error.shape[1]
        return np.sqrt(squared_error.sum(axis=(1, 2), dtype=np.float64) / count)

    def _chosen(self, windows: np.ndarray | None) -> np.ndarray:
        if windows is None:
            return self.exists
        return self.exists & (windows if windows.ndim == 2 else windows[:, None])
