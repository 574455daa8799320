"""A recorded trajectory and its scene."""

from dataclasses import dataclass, field

import numpy as np

from contactgraph.data.errors import InvalidInputError


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
    for a node that is no box. None: no node is. Serves drawing only; training never reads it."""
    candidate_edges: np.ndarray | None = None
    """[E, 2] int: pairs of nodes that could touch. None: every pair."""
    metadata: dict[str, str | int | float | bool] = field(default_factory=dict)
    """Free-form: task, seed, simulator version, substeps, …"""

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
        if self.size is not None:
            _check_size(self.size, self.node_name)
        if self.candidate_edges is not None:
            _set(self, "candidate_edges", _checked_edges(self.candidate_edges, count))

    @property
    def node_count(self) -> int:
        """N, the number of nodes."""
        return len(self.node_name)

    @property
    def has_weight(self) -> bool:
        """Whether bodies have weight."""
        return self.gravity is not None and bool(np.any(self.gravity != 0.0))

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


def _set(instance: object, name: str, value: object) -> None:
    object.__setattr__(instance, name, value)


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
    """[T, U] N; U may be 0."""
    contact: np.ndarray | None = None
    """[T+1, N, N] bool, symmetric: whether two nodes touch at a step. None: not recorded."""
    link_positions: np.ndarray | None = None
    """[T+1, P, D] m: joints, joined by lines in their order, of a drawn body that is no node,
    such as an arm from base to hand. None: there is none. Training never reads it."""
    tracked: np.ndarray | None = None
    """[T+1, N] bool: whether the position of a node was being tracked. None: simulated, or not
    known. Training never reads it."""
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
        if self.link_positions is not None:
            self._check_link_positions(state_shape)
        for name in ("position", "velocity", "control", "link_positions"):
            value = getattr(self, name)
            if value is not None and not np.all(np.isfinite(value)):
                where = [int(i) for i in np.argwhere(~np.isfinite(value))[0]]
                raise InvalidInputError(
                    f"{name} must be finite, found {value[tuple(where)]} at {where}"
                )
        if self.contact is not None:
            self._check_contact(steps)
        self._check_measuring(state_shape[:2])

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
