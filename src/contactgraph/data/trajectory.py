"""A recorded trajectory, and the constants of its scene."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.outlines import check_outline, signed_area
from contactgraph.data.schema import (
    ABSENT,
    BOUNDS,
    FINITE_OR_NONE,
    NODES,
    NOT_NEGATIVE,
    PAIRS,
    PLANES,
    SIDES_OR_NONE,
    SYMMETRIC,
    TURNS_OR_NONE,
    Field,
    check_fields,
    fields_of,
    given_fields,
)
from contactgraph.data.turns import continued_angles, rotation_vectors, turned_by

CONTROL_KINDS = ("force", "position", "displacement", "velocity", "switch", "other")
"""Meanings of a component of the control, by `Scene.control_kind`."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The properties of a scene that stay constant along a trajectory.

    Raises `InvalidInputError` where a field has the wrong shape, a value that is not finite,
    or names that are not unique.
    """

    node_name: Annotated[tuple[str, ...], Field("N", str)]
    """[N] unique names, e.g. ``("gripper", "object-0")``."""
    node_type: Annotated[tuple[str, ...], Field("N", str)]
    """[N] types of node, e.g. ``("gripper", "object")``."""
    actuated: Annotated[np.ndarray, Field("N", bool)]
    """[N] bool: whether the control acts on the node itself."""
    dt: float
    """Time between two steps, s."""
    dimension: int = 2
    """D, degrees of freedom a node."""
    anchor: Annotated[
        np.ndarray, Field("N D", unit="m", rule=FINITE_OR_NONE, place=True, fill=np.nan)
    ] = ABSENT
    """[N, D] hinge position, m; NaN where a node has none."""
    goal: Annotated[np.ndarray | None, Field("D", unit="m", place=True)] = None
    """[D] goal position, m. None: there is no goal."""
    gravity: Annotated[np.ndarray, Field("D", unit="m/s^2", fill=0.0)] = ABSENT
    """[D] m/s^2: acceleration of bodies without support or actuation. They rest on a support until
    they are lifted. 0: bodies have no weight, or lie on a plane that supports it."""
    mass: Annotated[np.ndarray | None, Field("N", unit="kg", rule=NOT_NEGATIVE)] = None
    """[N] true mass, kg, where it is known. Serves evaluation only; training never reads it."""
    radius: Annotated[np.ndarray | None, Field("N", unit="m", rule=NOT_NEGATIVE)] = None
    """[N] radius, m, where it is known. Serves drawing only; training never reads it."""
    size: Annotated[np.ndarray, Field("N D", unit="m", rule=SIDES_OR_NONE, fill=np.nan)] = ABSENT
    """[N, D] side lengths of a box around each node's position, along the axes, m; NaN throughout
    for a node that is no box."""
    candidate_edges: Annotated[np.ndarray | None, Field("E 2", int, rule=PAIRS)] = None
    """[E, 2] int: pairs of nodes that could touch. None: every pair."""
    static: Annotated[np.ndarray, Field("N", bool, fill=False)] = ABSENT
    """[N] bool: bodies that are known never to move, such as pillars and walls."""
    control_kind: Annotated[tuple[str, ...] | None, Field("U", str)] = None
    """[U] the meaning of each component of the control: ``force`` (N), ``position`` (a target in
    the world, m), ``displacement`` (a target relative to the body, m), ``velocity`` (m/s),
    ``switch`` (0 off to 1 on, moves nothing by itself) or ``other``. None: all are forces."""
    control_of: Annotated[np.ndarray | None, Field("N U", bool)] = None
    """[N, U] bool: the components that act on each node. None: component d moves degree of freedom
    d of every actuated node, and further components move nothing."""
    planes: Annotated[np.ndarray, Field("P D+1", rule=PLANES, fill=0.0)] = ABSENT
    """[P, D+1] rows of a unit normal n and an offset o, m: space is free where n·x >= o."""
    reach: Annotated[np.ndarray, Field("N 2 D", unit="m", rule=BOUNDS, place=True, fill=np.nan)] = (
        ABSENT
    )
    """[N, 2, D] m: lower and upper bounds of the position of an actuated body, such as a robot's
    workspace; NaN where there is none."""
    polygons: Annotated[tuple[np.ndarray, ...], Field("Q V D", unit="m", fill=0.0)] = ABSENT
    """[Q] convex outlines [V, 2] of nodes in the plane, in space points [V, 3] whose convex hulls
    they are, in the body's frame, m."""
    polygon_of: Annotated[np.ndarray, Field("Q", int, rule=NODES, fill=0)] = ABSENT
    """[Q] int: the node of each polygon; several may belong to one. Given with ``polygons``."""
    pins: Annotated[np.ndarray, Field("J 2", int, rule=PAIRS, fill=0)] = ABSENT
    """[J, 2] int: two nodes each, in the plane, that a joint holds together at a point and lets
    turn."""
    pin_points: Annotated[np.ndarray, Field("J 2 D", unit="m", fill=0.0)] = ABSENT
    """[J, 2, D] m: that point in the frame of either body. Given with ``pins``."""
    metadata: dict[str, str | int | float | bool] = field(default_factory=dict)
    """Free-form: task, seed, simulator version, substeps, …"""

    def __repr__(self) -> str:
        types = {name: self.node_type.count(name) for name in self.node_type}
        nodes = ", ".join(f"{count} {name}" for name, count in types.items())
        return f"Scene({nodes}; N={self.node_count}, D={self.dimension}, dt={self.dt:g} s)"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise InvalidInputError(f"dt must be a positive number of seconds, found {self.dt}")
        fields = fields_of(self)
        for name, other in (("polygons", "polygon_of"), ("pins", "pin_points")):
            if len({fields[each].is_absent(getattr(self, each)) for each in (name, other)}) > 1:
                raise InvalidInputError(f"{name} and {other} must be given together")
        check_fields(self, {"D": self.dimension}, tuple(self.node_name))
        if self.polygons and self.dimension not in (2, 3):
            raise InvalidInputError(
                f"polygons need a scene of 2 or 3 dimensions, found {self.dimension}"
            )
        if len(self.pins) and self.dimension != 2:
            raise InvalidInputError(
                f"pins need a scene in the plane, found {self.dimension} dimensions"
            )
        if len(set(self.node_name)) != self.node_count:
            raise InvalidInputError(f"node_name must be unique, found {list(self.node_name)}")
        for kind in self.control_kind or ():
            if kind not in CONTROL_KINDS:
                raise InvalidInputError(
                    f"control_kind must name {', '.join(CONTROL_KINDS)}, found {kind!r}"
                )
        for index, outline in enumerate(self.polygons):
            check_outline(f"polygons[{index}]", outline)
        self._check_actuated()

    def _check_actuated(self) -> None:
        """Raises `InvalidInputError` for a static node that is actuated, or a bound of one that is
        not."""
        for node in np.flatnonzero(self.static & self.actuated):
            raise InvalidInputError(
                f"static must name nodes that are not actuated, found {self.node_name[node]!r}"
            )
        bounded = np.any(np.isfinite(self.reach), axis=(1, 2))
        for node in np.flatnonzero(bounded & ~self.actuated):
            raise InvalidInputError(
                f"reach must be NaN for nodes that are not actuated, found "
                f"{self.reach[node].tolist()} for {self.node_name[node]!r}"
            )

    @property
    def node_count(self) -> int:
        """N, the number of nodes."""
        return len(self.node_name)

    @property
    def half_size(self) -> np.ndarray:
        """[N, D] m, half the sides of each box; 0 for other nodes."""
        return 0.5 * np.nan_to_num(self.size)

    def outlines_of(self, node: int) -> list[np.ndarray]:
        """The convex outlines [V, D] m of a node, in the plane counter-clockwise; none where they
        are not known."""
        mine = [self.polygons[index] for index in np.flatnonzero(self.polygon_of == node)]
        if self.dimension == 3:
            return mine
        return [each if signed_area(each) > 0.0 else each[::-1] for each in mine]

    @property
    def has_weight(self) -> bool:
        """Whether bodies have weight."""
        return bool(np.any(self.gravity != 0.0))

    @property
    def hinged(self) -> np.ndarray:
        """[N] bool: the nodes that hang on a hinge."""
        return np.asarray(np.isfinite(self.anchor).all(axis=1))

    @property
    def passive(self) -> np.ndarray:
        """[N] bool: the nodes that may move and on which no control acts."""
        return ~(self.actuated | self.static)

    @property
    def outlined(self) -> np.ndarray:
        """[N] bool: the nodes of which an outline is given."""
        return np.isin(np.arange(self.node_count), self.polygon_of)


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


def box_distance(offset: np.ndarray, half_size: np.ndarray) -> np.ndarray:
    """[...] m: the distance of a point at ``offset`` [..., D] m from a box's centre to the box, as
    if that were a ball of half its shortest side."""
    beyond = np.abs(offset) - half_size
    gap = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return np.asarray(gap + np.minimum(beyond.max(axis=-1), 0.0) + half_size.min(axis=-1))
