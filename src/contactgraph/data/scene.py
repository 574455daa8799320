"""What never changes in a run: who takes part, who is actuated, and where the goal is."""

from dataclasses import dataclass, field

import numpy as np

from contactgraph.data.errors import InvalidInputError


@dataclass(frozen=True, eq=False)
class Scene:
    """What never changes in a recorded run.

    Raises `InvalidInputError` where a field has the wrong shape, a value that is not finite,
    or names that are not unique.
    """

    node_name: tuple[str, ...]
    """[N] unique names, e.g. ``("gripper", "object-0")``."""
    node_type: tuple[str, ...]
    """[N] kinds of node, e.g. ``("gripper", "object")``."""
    actuated: np.ndarray
    """[N] bool: whether the control acts on the node itself."""
    dt: float
    """Time between two steps, s."""
    dimension: int = 2
    """D, degrees of freedom a node."""
    anchor: np.ndarray | None = None
    """[N, D] hinge position, m; NaN where a node has none. None: nobody has one."""
    goal: np.ndarray | None = None
    """[D] goal position, m. None: the run has no goal."""
    gravity: np.ndarray | None = None
    """[D] m/s^2: how bodies fall that nothing bears and nothing actuates. They rest on something
    until they are carried. None: bodies have no weight, or lie in a plane that bears them."""
    mass: np.ndarray | None = None
    """[N] true mass, kg, where it is known. Serves evaluation only; training never reads it."""
    radius: np.ndarray | None = None
    """[N] radius, m, where it is known. Serves drawing only; training never reads it."""
    size: np.ndarray | None = None
    """[N, D] side lengths of a box around each node's position, along the axes, m; NaN throughout
    for a node that is no box. None: nobody is. Serves drawing only; training never reads it."""
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
