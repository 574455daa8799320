"""The constants of a recorded scene."""

from dataclasses import dataclass, field

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.outlines import checked_polygons, signed_area
from contactgraph.data.pins import checked_pins

CONTROL_KINDS = ("force", "position", "displacement", "velocity", "switch", "other")
"""Meanings of a component of the control, by `Scene.control_kind`."""
_UNIT_TOLERANCE = 1e-6
"""Largest error of the length of a plane's normal."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The properties of a scene that stay constant along a trajectory.

    Raises `InvalidInputError` where a field has the wrong shape, a value that is not finite,
    or names that are not unique.
    """

    node_name: tuple[str, ...]
    """[N] unique names, e.g. ``("gripper", "object-0")``."""
    node_type: tuple[str, ...]
    """[N] types of node, e.g. ``("gripper", "object")``."""
    actuated: np.ndarray
    """[N] bool: whether the control acts on the node itself."""
    dt: float
    """Time between two steps, s."""
    dimension: int = 2
    """D, degrees of freedom a node."""
    anchor: np.ndarray | None = None
    """[N, D] hinge position, m; NaN where a node has none. None: no node has one."""
    goal: np.ndarray | None = None
    """[D] goal position, m. None: there is no goal."""
    gravity: np.ndarray | None = None
    """[D] m/s^2: acceleration of bodies without support or actuation. They rest on a support until
    they are lifted. None: bodies have no weight, or lie on a plane that supports it."""
    mass: np.ndarray | None = None
    """[N] true mass, kg, where it is known. Serves evaluation only; training never reads it."""
    radius: np.ndarray | None = None
    """[N] radius, m, where it is known. Serves drawing only; training never reads it."""
    size: np.ndarray | None = None
    """[N, D] side lengths of a box around each node's position, along the axes, m; NaN throughout
    for a node that is no box. None: no node is."""
    candidate_edges: np.ndarray | None = None
    """[E, 2] int: pairs of nodes that could touch. None: every pair."""
    static: np.ndarray | None = None
    """[N] bool: bodies that never move, such as pillars and walls. None: not known."""
    control_kind: tuple[str, ...] | None = None
    """[U] the meaning of each component of the control: ``force`` (N), ``position`` (a target in
    the world, m), ``displacement`` (a target relative to the body, m), ``velocity`` (m/s),
    ``switch`` (0 off to 1 on, moves nothing by itself) or ``other``. None: all are forces."""
    control_of: np.ndarray | None = None
    """[N, U] bool: the components that act on each node. None: component d moves degree of freedom
    d of every actuated node, and further components move nothing."""
    planes: np.ndarray | None = None
    """[P, D+1] rows of a unit normal n and an offset o, m: space is free where n·x >= o. None: not
    known."""
    reach: np.ndarray | None = None
    """[N, 2, D] m: lower and upper bounds of the position of an actuated body, such as a robot's
    workspace; NaN where there is none. None: not known."""
    polygons: tuple[np.ndarray, ...] | None = None
    """[P] convex outlines [V, 2] of nodes in the plane, in space points [V, 3] whose convex hulls
    they are, in the body's frame, m. None: not known."""
    polygon_of: np.ndarray | None = None
    """[P] int: the node of each polygon; several may belong to one. Given with ``polygons``."""
    pins: np.ndarray | None = None
    """[P, 2] int: two nodes each, in the plane, that a joint holds together at a point and lets
    turn. None: not known."""
    pin_points: np.ndarray | None = None
    """[P, 2, D] m: that point in the frame of either body. Given with ``pins``."""
    metadata: dict[str, str | int | float | bool] = field(default_factory=dict)
    """Free-form: task, seed, simulator version, substeps, …"""

    def __repr__(self) -> str:
        types = {name: self.node_type.count(name) for name in self.node_type}
        nodes = ", ".join(f"{count} {name}" for name, count in types.items())
        return f"Scene({nodes}; N={self.node_count}, D={self.dimension}, dt={self.dt:g} s)"

    def __post_init__(self) -> None:
        count, dimension = len(self.node_name), self.dimension
        _set(self, "actuated", np.asarray(self.actuated, dtype=bool))
        if len(set(self.node_name)) != count:
            raise InvalidInputError(f"node_name must be unique, found {list(self.node_name)}")
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise InvalidInputError(f"dt must be a positive number of seconds, found {self.dt}")
        shapes = {
            "actuated": (count,),
            "anchor": (count, dimension),
            "goal": (dimension,),
            "gravity": (dimension,),
            "mass": (count,),
            "radius": (count,),
            "size": (count, dimension),
        }
        if len(self.node_type) != count:
            raise InvalidInputError(
                f"node_type must have one entry a node ({count}), found {len(self.node_type)}"
            )
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if name != "actuated":
                value = np.asarray(value, dtype=np.float64)
                _set(self, name, value)
            if value.shape != shape:
                raise InvalidInputError(f"{name} must have shape {shape}, found {value.shape}")
        for name in ("goal", "gravity", "mass", "radius"):
            value = getattr(self, name)
            if value is not None and not np.all(np.isfinite(value)):
                raise InvalidInputError(f"{name} must be finite, found {value.tolist()}")
        for name in ("mass", "radius"):
            value = getattr(self, name)
            if value is not None and np.any(value < 0.0):
                raise InvalidInputError(f"{name} must not be negative, found {value.tolist()}")
        if self.size is not None:
            _check_size(self.size, self.node_name)
        if self.candidate_edges is not None:
            _set(self, "candidate_edges", _checked_edges(self.candidate_edges, count))
        if self.static is not None:
            _set(self, "static", _checked_static(self.static, self.actuated, self.node_name))
        if self.control_kind is not None:
            _set(self, "control_kind", _checked_kinds(self.control_kind))
        if self.control_of is not None:
            _set(self, "control_of", _checked_control_of(self.control_of, count))
        if self.planes is not None:
            _set(self, "planes", _checked_planes(self.planes, dimension))
        if self.reach is not None:
            _set(
                self, "reach", _checked_reach(self.reach, self.actuated, dimension, self.node_name)
            )
        if self.polygons is not None or self.polygon_of is not None:
            polygons, nodes = checked_polygons(self.polygons, self.polygon_of, count, dimension)
            _set(self, "polygons", polygons)
            _set(self, "polygon_of", nodes)
        if self.pins is not None or self.pin_points is not None:
            pins, points = checked_pins(self.pins, self.pin_points, count, dimension)
            _set(self, "pins", pins)
            _set(self, "pin_points", points)

    @property
    def node_count(self) -> int:
        """N, the number of nodes."""
        return len(self.node_name)

    @property
    def half_size(self) -> np.ndarray | None:
        """[N, D] m, half the sides of each box; 0 for other nodes. None: no node is a box."""
        return None if self.size is None else 0.5 * np.nan_to_num(self.size)

    def outlines_of(self, node: int) -> list[np.ndarray]:
        """The convex outlines [V, D] m of a node, in the plane counter-clockwise; none where they
        are not known."""
        if self.polygons is None or self.polygon_of is None:
            return []
        mine = [self.polygons[index] for index in np.flatnonzero(self.polygon_of == node)]
        if self.dimension == 3:
            return mine
        return [each if signed_area(each) > 0.0 else each[::-1] for each in mine]

    @property
    def has_weight(self) -> bool:
        """Whether bodies have weight."""
        return self.gravity is not None and bool(np.any(self.gravity != 0.0))

    @property
    def has_reach(self) -> bool:
        """Whether the reach of some node is bounded."""
        return self.reach is not None and bool(np.any(np.isfinite(self.reach)))

    @property
    def has_hinges(self) -> bool:
        """Whether some node hangs on a hinge."""
        return self.anchor is not None and bool(np.any(np.isfinite(self.anchor)))


def _check_size(size: np.ndarray, names: tuple[str, ...]) -> None:
    box = np.all(np.isfinite(size) & (size > 0.0), axis=1)
    for node in np.flatnonzero(~(box | np.all(np.isnan(size), axis=1))):
        raise InvalidInputError(
            f"size must be positive, or NaN throughout for a node that is no box, "
            f"found {size[node].tolist()} for {names[node]!r}"
        )


def _checked_edges(edges: np.ndarray, count: int) -> np.ndarray:
    edges = np.asarray(edges, dtype=np.int64)
    if edges.ndim != 2 or edges.shape[1] != 2:
        raise InvalidInputError(f"candidate_edges must have shape (E, 2), found {edges.shape}")
    if edges.size and (edges.min() < 0 or edges.max() >= count):
        raise InvalidInputError(f"candidate_edges must name nodes 0 to {count - 1}")
    if np.any(edges[:, 0] == edges[:, 1]):
        raise InvalidInputError("candidate_edges must join two different nodes")
    return edges


def _checked_static(static: np.ndarray, actuated: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    static = np.asarray(static, dtype=bool)
    if static.shape != actuated.shape:
        raise InvalidInputError(f"static must have shape {actuated.shape}, found {static.shape}")
    for node in np.flatnonzero(static & actuated):
        raise InvalidInputError(
            f"static must name nodes that are not actuated, found {names[node]!r}"
        )
    return static


def _checked_kinds(kinds: tuple[str, ...]) -> tuple[str, ...]:
    kinds = tuple(str(each) for each in kinds)
    for each in kinds:
        if each not in CONTROL_KINDS:
            raise InvalidInputError(
                f"control_kind must name {', '.join(CONTROL_KINDS)}, found {each!r}"
            )
    return kinds


def _checked_control_of(control_of: np.ndarray, count: int) -> np.ndarray:
    control_of = np.asarray(control_of, dtype=bool)
    if control_of.ndim != 2 or len(control_of) != count:
        raise InvalidInputError(
            f"control_of must have shape (N, U) with N = {count}, found {control_of.shape}"
        )
    return control_of


def _checked_planes(planes: np.ndarray, dimension: int) -> np.ndarray:
    planes = np.asarray(planes, dtype=np.float64)
    if planes.ndim != 2 or planes.shape[1] != dimension + 1:
        raise InvalidInputError(
            f"planes must have shape (P, D+1) = (P, {dimension + 1}), found {planes.shape}"
        )
    length = np.linalg.norm(planes[:, :-1], axis=1)
    wrong = ~np.isfinite(planes).all(axis=1) | ~(np.abs(length - 1.0) <= _UNIT_TOLERANCE)
    for plane in np.flatnonzero(wrong):
        raise InvalidInputError(
            f"planes must be a normal of length 1 and a finite offset, "
            f"found {planes[plane].tolist()} in row {plane}"
        )
    return planes


def _checked_reach(
    reach: np.ndarray, actuated: np.ndarray, dimension: int, names: tuple[str, ...]
) -> np.ndarray:
    reach = np.asarray(reach, dtype=np.float64)
    shape = (len(actuated), 2, dimension)
    if reach.shape != shape:
        raise InvalidInputError(f"reach must have shape (N, 2, D) = {shape}, found {reach.shape}")
    wrong = np.any(np.isinf(reach), axis=(1, 2)) | np.any(reach[:, 0] >= reach[:, 1], axis=1)
    for node in np.flatnonzero(wrong):
        raise InvalidInputError(
            "reach must be lower bounds below upper ones, each finite or NaN for none, "
            f"found {reach[node].tolist()} for {names[node]!r}"
        )
    for node in np.flatnonzero(~actuated & np.any(np.isfinite(reach), axis=(1, 2))):
        raise InvalidInputError(
            f"reach must be NaN for nodes that are not actuated, found "
            f"{reach[node].tolist()} for {names[node]!r}"
        )
    return reach


def _set(instance: object, name: str, value: object) -> None:
    object.__setattr__(instance, name, value)


def box_distance(offset: np.ndarray, half_size: np.ndarray) -> np.ndarray:
    """[...] m: the distance of a point at ``offset`` [..., D] m from a box's centre to the box, as
    if that were a ball of half its shortest side."""
    beyond = np.abs(offset) - half_size
    gap = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return np.asarray(gap + np.minimum(beyond.max(axis=-1), 0.0) + half_size.min(axis=-1))
