"""What the sensors said, brought into the planner's shapes. Runs on the host, once a tick."""

from collections.abc import Mapping

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.graph import pair_indices

Observation = Mapping[str, np.ndarray]
"""``position`` [n, D] m and ``velocity`` [n, D] m/s of the first n nodes; other keys are ignored,
so that a task's observation can be handed over as it is."""


class MeasurementReader:
    """Pads measurements to the capacity of ``N`` nodes and lists contacts by edge."""

    def __init__(self, capacity: int, dimension: int, dtype: np.dtype) -> None:
        self.capacity = capacity
        self.dimension = dimension
        self.dtype = dtype
        pairs = pair_indices(capacity)
        self._first, self._second = pairs[:, 0], pairs[:, 1]
        self._unmeasured = np.full(len(pairs), np.nan, dtype)

    def motion(self, observation: Observation) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity, each [N, D]. Numbers may be non-finite; shapes must fit."""
        position = self._padded(observation, "position")
        velocity = self._padded(observation, "velocity")
        return position, velocity

    def contact(self, contacts: np.ndarray | None) -> np.ndarray:
        """[E] from a matrix [n, n]; NaN, here as there, is not measured. None: nothing is.

        Where only one of ``[i, j]`` and ``[j, i]`` was measured, that one counts.
        """
        if contacts is None:
            return self._unmeasured
        matrix = np.asarray(contacts, self.dtype)
        count = matrix.shape[0] if matrix.ndim == 2 else -1
        if matrix.ndim != 2 or matrix.shape[1] != count or count > self.capacity:
            raise InvalidInputError(
                f"contacts must have shape (n, n) with n <= {self.capacity}, the capacity; "
                f"found {matrix.shape}"
            )
        edges = count * (count - 1) // 2
        # The edges of fewer nodes come first in the order of any capacity.
        first, second = self._first[:edges], self._second[:edges]
        one, other = matrix[first, second], matrix[second, first]
        measured = self._unmeasured.copy()
        measured[:edges] = np.where(np.isfinite(one), one, other)
        return measured

    def _padded(self, observation: Observation, name: str) -> np.ndarray:
        if name not in observation:
            raise InvalidInputError(
                f"observation must have position and velocity, found {sorted(observation)}"
            )
        value = np.asarray(observation[name], self.dtype)
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
