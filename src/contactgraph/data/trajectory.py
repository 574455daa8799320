"""A recorded trajectory."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.scene import Scene
from contactgraph.data.schema import (
    ABSENT,
    FINITE_OR_NONE,
    SYMMETRIC,
    TURNS_OR_NONE,
    Field,
    check_fields,
    given_fields,
)
from contactgraph.data.turns import continued_angles, rotation_vectors, turned_by


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One recorded trajectory of ``T`` steps with ``N`` nodes of ``D`` degrees of freedom.

    Step ``t`` leads from state ``t`` to state ``t + 1`` under ``control[t]``.
    Raises `InvalidInputError` where a shape is wrong or a number is not finite.
    """

    scene: Scene
    position: Annotated[np.ndarray, Field("T+1 N D", unit="m", place=True)]
    """[T+1, N, D] m."""
    velocity: Annotated[np.ndarray, Field("T+1 N D", unit="m/s")]
    """[T+1, N, D] m/s."""
    control: Annotated[np.ndarray, Field("T U", unit="N")]
    """[T, U] N, or in the units of `Scene.control_kind`; U may be 0."""
    contact: Annotated[np.ndarray | None, Field("T+1 N N", bool, rule=SYMMETRIC)] = None
    """[T+1, N, N] bool, symmetric: whether two nodes touch or hold each other at a step. None: not
    recorded."""
    link_positions: Annotated[np.ndarray | None, Field("T+1 L D", unit="m", place=True)] = None
    """[T+1, L, D] m: joints, joined by lines in their order, of a drawn body that is no node,
    such as an arm from base to hand. None: there is none. Training never reads it."""
    tracked: Annotated[np.ndarray | None, Field("T+1 N", bool)] = None
    """[T+1, N] bool: whether the position of a node was being tracked. None: simulated, or not
    known. Training never reads it."""
    measured_at: Annotated[np.ndarray | None, Field("T+1 N", unit="s")] = None
    """[T+1, N] s from the first state on: when each node was last measured, as known at that step.
    None: at that very time. Training never reads it."""
    holding: Annotated[np.ndarray | None, Field("T+1 N N", bool, rule=SYMMETRIC)] = None
    """[T+1, N, N] bool, symmetric: whether two nodes are tied together at a step, by a grasp, a
    joint or suction; nodes that hold each other are in contact. None: not recorded."""
    orientation: Annotated[np.ndarray, Field("T+1 N 1|4", rule=TURNS_OR_NONE, fill=np.nan)] = ABSENT
    """[T+1, N, 4] unit quaternions (w, x, y, z) in space (D = 3), else [T+1, N, 1] rad, which go on
    without jumps of whole turns; NaN throughout for a node at a step where it is not known."""
    angular_velocity: Annotated[
        np.ndarray, Field("T+1 N 1|3", unit="rad/s", rule=FINITE_OR_NONE, fill=np.nan)
    ] = ABSENT
    """[T+1, N, 3] rad/s in the world's axes in space (D = 3), else [T+1, N, 1]; NaN throughout
    for a node at a step where it is not known."""

    def __post_init__(self) -> None:
        scene = self.scene
        sizes = {"N": scene.node_count, "D": scene.dimension}
        check_fields(self, sizes, scene.node_name)
        check_fields(scene, sizes, scene.node_name)  # now that U is known
        if self.contact is not None and self.holding is not None:
            for step, first, second in np.argwhere(self.holding & ~self.contact):
                names = scene.node_name
                raise InvalidInputError(
                    f"holding must imply contact, found {names[first]!r} holding "
                    f"{names[second]!r} without contact at step {step}"
                )
        if self.orientation.shape[2] == 1:
            self._continue_angles(self.orientation)

    def __repr__(self) -> str:
        always = ("position", "velocity", "control")
        given = [name for name in given_fields(self) if name not in always]
        sizes = f"T={self.steps}, N={self.scene.node_count}, D={self.scene.dimension}"
        return f"Trajectory({', '.join([sizes, f'U={self.control_size}', *given])})"

    def outlines_of(self, node: int) -> list[np.ndarray]:
        """[T+1, V, D] m each: a node's polygons where it is; none for a node without an outline.

        They are not turned where the orientation is not known.
        """
        dimension = self.scene.dimension
        angle = self.orientation[:, node]
        vectors = angle * [0.0, 0.0, 1.0] if dimension == 2 else rotation_vectors(angle)
        turn = np.nan_to_num(vectors)[:, None]
        return [
            self.position[:, node, None]
            + turned_by(turn, np.pad(outline, ((0, 0), (0, 3 - dimension))))[..., :dimension]
            for outline in self.scene.outlines_of(node)
        ]

    def _continue_angles(self, angle: np.ndarray) -> None:
        """Continues the angles of nodes that all lie within one turn, as those of an arctangent."""
        with np.errstate(invalid="ignore"):
            span = np.fmax.reduce(angle, axis=0) - np.fmin.reduce(angle, axis=0)
        found = continued_angles(angle, self.angular_velocity, self.scene.dt)
        if found is not angle:
            kept = np.where(span <= 2.0 * np.pi, found, angle)
            object.__setattr__(self, "orientation", kept)

    @property
    def steps(self) -> int:
        """T, the number of steps."""
        return self.position.shape[0] - 1

    @property
    def control_size(self) -> int:
        """U, the size of the control."""
        return self.control.shape[1]
