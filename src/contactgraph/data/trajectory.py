"""A recorded trajectory."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.scene import Scene
from contactgraph.data.turns import continued_angles, rotation_vectors, turned_by

_UNIT_TOLERANCE = 1e-3
"""Largest error of a quaternion's length, which leaves room for 16-bit floats."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One recorded trajectory of ``T`` steps with ``N`` nodes of ``D`` degrees of freedom.

    Step ``t`` leads from state ``t`` to state ``t + 1`` under ``control[t]``.
    Raises `InvalidInputError` where a shape is wrong or a number is not finite.
    """

    scene: Scene
    position: np.ndarray
    """[T+1, N, D] m."""
    velocity: np.ndarray
    """[T+1, N, D] m/s."""
    control: np.ndarray
    """[T, U] N, or in the units of `Scene.control_kind`; U may be 0."""
    contact: np.ndarray | None = None
    """[T+1, N, N] bool, symmetric: whether two nodes touch or hold each other at a step. None: not
    recorded."""
    link_positions: np.ndarray | None = None
    """[T+1, P, D] m: joints, joined by lines in their order, of a drawn body that is no node,
    such as an arm from base to hand. None: there is none. Training never reads it."""
    tracked: np.ndarray | None = None
    """[T+1, N] bool: whether the position of a node was being tracked. None: simulated, or not
    known. Training never reads it."""
    measured_at: np.ndarray | None = None
    """[T+1, N] s from the first state on: when each node was last measured, as known at that step.
    None: at that very time. Training never reads it."""
    holding: np.ndarray | None = None
    """[T+1, N, N] bool, symmetric: whether two nodes are tied together at a step, by a grasp, a
    joint or suction; nodes that hold each other are in contact. None: not recorded."""
    orientation: np.ndarray | None = None
    """[T+1, N, 4] unit quaternions (w, x, y, z) in space (D = 3), else [T+1, N, 1] rad, which go on
    without jumps of whole turns; NaN throughout for a node at a step where it is not known. None:
    not recorded."""
    angular_velocity: np.ndarray | None = None
    """[T+1, N, 3] rad/s in the world's axes in space (D = 3), else [T+1, N, 1]; NaN throughout
    for a node at a step where it is not known. None: not recorded."""

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
        if self.link_positions is not None:
            self._check_link_positions(state_shape)
        for name in ("position", "velocity", "control", "link_positions"):
            value = getattr(self, name)
            if value is not None and not np.all(np.isfinite(value)):
                where = [int(i) for i in np.argwhere(~np.isfinite(value))[0]]
                raise InvalidInputError(
                    f"{name} must be finite, found {value[tuple(where)]} at {where}"
                )
        self._check_control()
        for name in ("contact", "holding"):
            self._check_pairs(name, steps)
        if self.contact is not None and self.holding is not None:
            self._check_holding(self.contact, self.holding)
        self._check_measuring(state_shape[:2])
        turning = (1, 1) if scene.dimension != 3 else (4, 3)
        self._check_turning("orientation", (*state_shape[:2], turning[0]))
        self._check_turning("angular_velocity", (*state_shape[:2], turning[1]))
        if self.orientation is not None and turning[0] == 1:
            self._continue_angles(self.orientation)

    def __repr__(self) -> str:
        optional = ("contact", "holding", "orientation", "angular_velocity", "link_positions")
        given = [name for name in optional if getattr(self, name) is not None]
        sizes = f"T={self.steps}, N={self.scene.node_count}, D={self.scene.dimension}"
        return f"Trajectory({', '.join([sizes, f'U={self.control_size}', *given])})"

    def _check_link_positions(self, state_shape: tuple[int, ...]) -> None:
        link_positions = np.asarray(self.link_positions, dtype=np.float64)
        object.__setattr__(self, "link_positions", link_positions)
        states, _, dimension = state_shape
        points = link_positions.shape[1] if link_positions.ndim == 3 else 0
        if points < 2 or link_positions.shape != (states, points, dimension):
            raise InvalidInputError(
                f"link_positions must have shape (T+1, P, D) = ({states}, P, {dimension}) with "
                f"P >= 2, found {link_positions.shape}"
            )

    def _check_control(self) -> None:
        kinds, acting = self.scene.control_kind, self.scene.control_of
        if kinds is not None and len(kinds) != self.control_size:
            raise InvalidInputError(
                f"control_kind must have one entry a component of the control "
                f"({self.control_size}), found {len(kinds)}"
            )
        if acting is not None and acting.shape[1] != self.control_size:
            raise InvalidInputError(
                f"control_of must have shape (N, U) = ({self.scene.node_count}, "
                f"{self.control_size}), found {acting.shape}"
            )

    def _check_pairs(self, name: str, steps: int) -> None:
        if getattr(self, name) is None:
            return
        value = np.asarray(getattr(self, name), dtype=bool)
        object.__setattr__(self, name, value)
        shape = (steps + 1, self.scene.node_count, self.scene.node_count)
        if value.shape != shape:
            raise InvalidInputError(
                f"{name} must have shape (T+1, N, N) = {shape}, found {value.shape}"
            )
        if not np.array_equal(value, value.swapaxes(1, 2)):
            raise InvalidInputError(f"{name} must be symmetric in its two node axes")

    def _check_holding(self, contact: np.ndarray, holding: np.ndarray) -> None:
        for step, first, second in np.argwhere(holding & ~contact):
            names = self.scene.node_name
            raise InvalidInputError(
                f"holding must imply contact, found {names[first]!r} holding {names[second]!r} "
                f"without contact at step {step}"
            )

    def outlines_of(self, node: int) -> list[np.ndarray]:
        """[T+1, V, D] m each: a node's polygons where it is; none for a node without an outline.

        They are not turned where the orientation is not known.
        """
        turned, outlines = self.orientation, self.scene.outlines_of(node)
        if self.scene.dimension == 3:
            turn = np.zeros((len(self.position), 1, 3))
            if turned is not None:
                turn[:, 0] = np.nan_to_num(rotation_vectors(turned[:, node]))
            return [self.position[:, node, None] + turned_by(turn, each) for each in outlines]
        angle = (
            np.zeros(len(self.position)) if turned is None else np.nan_to_num(turned[:, node, 0])
        )
        cosine, sine = np.cos(angle), np.sin(angle)
        turn = np.moveaxis(np.array([[cosine, sine], [-sine, cosine]]), -1, 0)
        return [self.position[:, node, None] + outline @ turn for outline in outlines]

    def _check_turning(self, name: str, shape: tuple[int, ...]) -> None:
        """Checks an orientation or angular velocity of this shape, where there is one."""
        if getattr(self, name) is None:
            return
        value = np.asarray(getattr(self, name), dtype=np.float64)
        object.__setattr__(self, name, value)
        if value.shape != shape:
            raise InvalidInputError(
                f"{name} must have shape (T+1, N, {shape[2]}) = {shape}, found {value.shape}"
            )
        known = np.isfinite(value).all(axis=2)
        for step, node in np.argwhere(~known & ~np.isnan(value).all(axis=2)):
            raise InvalidInputError(
                f"{name} must be finite, or NaN throughout where it is not known, "
                f"found {value[step, node].tolist()} for {self.scene.node_name[node]!r} at "
                f"step {step}"
            )
        if shape[2] == 4:
            length = np.linalg.norm(value, axis=2)
            for step, node in np.argwhere(known & ~(np.abs(length - 1.0) <= _UNIT_TOLERANCE)):
                raise InvalidInputError(
                    f"{name} must be quaternions of length 1, found {value[step, node].tolist()} "
                    f"for {self.scene.node_name[node]!r} at step {step}"
                )

    def _continue_angles(self, angle: np.ndarray) -> None:
        """Continues the angles of nodes that all lie within one turn, as those of an arctangent."""
        with np.errstate(invalid="ignore"):
            span = np.fmax.reduce(angle, axis=0) - np.fmin.reduce(angle, axis=0)
        found = continued_angles(angle, self.angular_velocity, self.scene.dt)
        if found is not angle:
            kept = np.where(span <= 2.0 * np.pi, found, angle)
            object.__setattr__(self, "orientation", kept)

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
