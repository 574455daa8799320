"""One recorded run."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.scene import Scene


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One recorded run of ``T`` steps with ``N`` nodes of ``D`` degrees of freedom.

    Step ``t`` leads from state ``t`` to state ``t + 1`` under ``control[t]``.
    Raises `InvalidInputError` where a shape is wrong or a number is not finite.
    """

    scene: Scene
    position: np.ndarray
    """[T+1, N, D] m."""
    velocity: np.ndarray
    """[T+1, N, D] m/s."""
    control: np.ndarray
    """[T, U] N; U may be 0."""
    contact: np.ndarray | None = None
    """[T+1, N, N] bool, symmetric: whether two nodes touch at a step. None: not recorded."""
    skeleton: np.ndarray | None = None
    """[T+1, P, D] m: points, joined by lines in their order, of a body that is drawn but is no
    node, such as an arm from base to hand. None: there is none. Training never reads it."""
    tracked: np.ndarray | None = None
    """[T+1, N] bool: whether whoever measured a node still knew where it was. None: simulated, or
    not told. Training never reads it."""
    measured_at: np.ndarray | None = None
    """[T+1, N] s from the first state on: when each node was last measured, as known at that step.
    None: at that very time. Training never reads it."""

    def __post_init__(self) -> None:
        scene = self.scene
        for name in ("position", "velocity", "control"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, value)
        if self.position.ndim != 3 or self.position.shape[0] < 2:
            raise InvalidInputError(
                f"position must have shape (T+1, N, D) with T >= 1, found {self.position.shape}"
            )
        steps = self.position.shape[0] - 1
        state_shape = (steps + 1, scene.node_count, scene.dimension)
        for name in ("position", "velocity"):
            value = getattr(self, name)
            if value.shape != state_shape:
                raise InvalidInputError(
                    f"{name} must have shape (T+1, N, D) = {state_shape}, found {value.shape}"
                )
        if self.control.ndim != 2 or self.control.shape[0] != steps:
            raise InvalidInputError(
                f"control must have shape (T, U) with T = {steps}, found {self.control.shape}"
            )
        if self.skeleton is not None:
            self._check_skeleton(state_shape)
        for name in ("position", "velocity", "control", "skeleton"):
            value = getattr(self, name)
            if value is not None and not np.all(np.isfinite(value)):
                where = [int(i) for i in np.argwhere(~np.isfinite(value))[0]]
                raise InvalidInputError(
                    f"{name} must be finite, found {value[tuple(where)]} at {where}"
                )
        if self.contact is not None:
            self._check_contact(steps)
        self._check_measuring(state_shape[:2])

    def _check_skeleton(self, state_shape: tuple[int, ...]) -> None:
        skeleton = np.asarray(self.skeleton, dtype=np.float64)
        object.__setattr__(self, "skeleton", skeleton)
        states, _, dimension = state_shape
        points = skeleton.shape[1] if skeleton.ndim == 3 else 0
        if points < 2 or skeleton.shape != (states, points, dimension):
            raise InvalidInputError(
                f"skeleton must have shape (T+1, P, D) = ({states}, P, {dimension}) with P >= 2, "
                f"found {skeleton.shape}"
            )

    def _check_contact(self, steps: int) -> None:
        contact = np.asarray(self.contact, dtype=bool)
        object.__setattr__(self, "contact", contact)
        shape = (steps + 1, self.scene.node_count, self.scene.node_count)
        if contact.shape != shape:
            raise InvalidInputError(
                f"contact must have shape (T+1, N, N) = {shape}, found {contact.shape}"
            )
        if not np.array_equal(contact, contact.swapaxes(1, 2)):
            raise InvalidInputError("contact must be symmetric in its two node axes")

    def _check_measuring(self, shape: tuple[int, ...]) -> None:
        for name, kind in (("tracked", bool), ("measured_at", np.float64)):
            value = getattr(self, name)
            if value is None:
                continue
            value = np.asarray(value, dtype=kind)
            object.__setattr__(self, name, value)
            if value.shape != shape:
                raise InvalidInputError(
                    f"{name} must have shape (T+1, N) = {shape}, found {value.shape}"
                )
            if not np.isfinite(value).all():
                raise InvalidInputError(f"{name} must be finite")

    @property
    def steps(self) -> int:
        """T, the number of steps."""
        return self.position.shape[0] - 1

    @property
    def control_size(self) -> int:
        """U, the size of the control."""
        return self.control.shape[1]
