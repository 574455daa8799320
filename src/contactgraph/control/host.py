"""What the sensors said, brought into the planner's shapes. Runs on the host, once a tick."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.graph import pair_indices

Observation = Mapping[str, np.ndarray]
"""``position`` [n, D] m and ``velocity`` [n, D] m/s of the first n nodes; other keys are ignored,
so that a task's observation can be handed over as it is."""


Motion = tuple[np.ndarray, np.ndarray]
"""Position m and velocity m/s of all nodes, each [N, D]."""


class MeasurementReader:
    """Pads measurements to the capacity of ``N`` nodes and lists contacts by edge."""

    def __init__(self, capacity: int, dimension: int, dtype: np.dtype) -> None:
        self.capacity = capacity
        self.dimension = dimension
        self.dtype = dtype
        self._pairs: dict[int, np.ndarray] = {}

    def motion(self, observation: Observation) -> Motion:
        """Numbers may be non-finite; shapes must fit."""
        position = self._padded(observation, "position")
        velocity = self._padded(observation, "velocity")
        return position, velocity

    def contact(self, contacts: np.ndarray | None, who: np.ndarray) -> np.ndarray:
        """[e] between the nodes ``who`` [n], of which -1 is padding, from a matrix [m, m] of all.

        NaN, here as there, is not measured. None: nothing is. Where only one of ``[i, j]`` and
        ``[j, i]`` was measured, that one counts.
        """
        count = len(who)
        if count not in self._pairs:
            self._pairs[count] = pair_indices(count).T
        first, second = who[self._pairs[count]]
        measured = np.full(len(first), np.nan, self.dtype)
        if contacts is None:
            return measured
        matrix = np.asarray(contacts)
        size = matrix.shape[0] if matrix.ndim == 2 else -1
        if matrix.ndim != 2 or matrix.shape[1] != size or size > self.capacity:
            raise InvalidInputError(
                f"contacts must have shape (n, n) with n <= {self.capacity}, the capacity; "
                f"found {matrix.shape}"
            )
        there = np.flatnonzero((first >= 0) & (second >= 0) & (first < size) & (second < size))
        first, second = first[there], second[there]
        one = matrix[first, second].astype(self.dtype)
        other = matrix[second, first].astype(self.dtype)
        measured[there] = np.where(np.isfinite(one), one, other)
        return measured

    def applied(self, applied: np.ndarray | None, control_size: int) -> np.ndarray:
        """[U] N; NaN where nobody said."""
        if applied is None:
            return np.full(control_size, np.nan, self.dtype)
        told = np.array(applied, self.dtype)
        if told.shape != (control_size,):
            raise InvalidInputError(
                f"applied must have shape ({control_size},), the control's, found {told.shape}"
            )
        return told

    def _padded(self, observation: Observation, name: str) -> np.ndarray:
        if name not in observation:
            raise InvalidInputError(
                f"observation must have position and velocity, found {sorted(observation)}"
            )
        # A copy: a robot may write its next observation where this one is while the tick runs.
        value = np.array(observation[name], self.dtype)
        if value.ndim != 2 or value.shape[1] != self.dimension or len(value) > self.capacity:
            raise InvalidInputError(
                f"observation's {name} must have shape (n, {self.dimension}) with "
                f"n <= {self.capacity}, the capacity; found {value.shape}"
            )
        if len(value) == self.capacity:
            return value
        padded = np.zeros((self.capacity, self.dimension), self.dtype)
        padded[: len(value)] = value
        return padded


@contextmanager
def pin_to_core(core: int | None = None) -> Iterator[None]:
    """All threads of this process share a core within; None: the last that it may use.

    A tick is a chain of small operations, some of which XLA hands to threads of its own. On one
    core that is a switch; on several, the tick waits until another core is awake and free, now
    and then for many milliseconds. Compiling wants all cores, so `MPC.reset` comes before::

        state = mpc.reset(observation, nodes, cost)
        with pin_to_core():
            while True:
                plan, state = mpc.step(observation, contacts, state)

    Threads begun within are there too, and free afterwards. Where the system does not let a
    process choose its cores (macOS, Windows), nothing is done. Raises `OSError` for a core that
    the process may not use.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    before = _places()
    os.sched_setaffinity(0, {max(allowed) if core is None else core})
    try:
        for thread in _places():
            _place(thread, os.sched_getaffinity(0))
        yield
    finally:
        for thread in _places():
            _place(thread, before.get(thread, allowed))


def _places() -> dict[int, set[int]]:
    """The cores that each thread of this process may use."""
    places = {}
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # It may have ended meanwhile.
            places[int(task.name)] = os.sched_getaffinity(int(task.name))
    return places


def _place(thread: int, cores: set[int]) -> None:
    with suppress(ProcessLookupError):
        os.sched_setaffinity(thread, cores)
