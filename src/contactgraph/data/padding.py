"""Padding of scenes and trajectories to arrays of one shape."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import pair_indices
from contactgraph.data.outlines import hull_rows
from contactgraph.data.schema import Field, fields_of
from contactgraph.data.trajectory import Scene, Trajectory
from contactgraph.data.trajectory_batch import Nodes, TrajectoryBatch, type_id
from contactgraph.data.turns import coordinate_count, generalized_coordinates

PROPERTIES = {
    **{name: field for name, field in fields_of(Scene).items() if name in Nodes._fields},
    "type_id": Field("N", np.int32),
    "half_size": Field("N D", fill=0.0),
    "outlines": Field("N Q V D", fill=0.0),
}
"""The fields of `Nodes` that scenes tell, by name."""


def pad_trajectories(
    trajectories: Iterable[Trajectory],
    node_capacity: int | None = None,
    steps: int | None = None,
    contacts: bool = True,
    turn_length: float | None = None,
) -> TrajectoryBatch[np.ndarray]:
    """Pad to ``steps`` (default: the longest) and ``node_capacity`` (default: the most nodes, but
    at least two, as a graph without edges is not supported).

    Contact labels are left out unless ``contacts``. ``turn_length``: see `generalized_coordinates`.
    Raises `InvalidInputError` where a trajectory has more nodes than the capacity.
    """
    trajectories = tuple(trajectories)
    most = max(each.scene.node_count for each in trajectories)
    capacity = max(2, most) if node_capacity is None else node_capacity
    if capacity < most:
        raise InvalidInputError(
            f"node_capacity must be at least {most}, the most nodes of a trajectory, "
            f"found {node_capacity}"
        )
    count, first = len(trajectories), trajectories[0]
    longest = max(each.steps for each in trajectories) if steps is None else steps
    size = coordinate_count(first.scene.dimension, turn_length)
    position = np.zeros((count, longest + 1, capacity, size))
    velocity = np.zeros_like(position)
    control = np.zeros((count, longest, first.control_size))
    edges = capacity * (capacity - 1) // 2
    contact = np.full((count, longest + 1, edges), np.nan) if contacts else None
    for index, each in enumerate(trajectories):
        real = slice(0, each.steps + 1), slice(0, each.scene.node_count)
        moved = generalized_coordinates(
            turn_length, each.position, each.velocity, each.orientation, each.angular_velocity
        )
        _check_turns(each, *moved)
        position[index][real], velocity[index][real] = np.nan_to_num(moved)
        control[index, : each.steps] = each.control
        if contact is not None and each.contact is not None:
            # The edges of fewer nodes are a prefix of those of the capacity: see `pair_indices`.
            pairs = pair_indices(each.scene.node_count)
            labels = each.contact[:, pairs[:, 0], pairs[:, 1]]
            contact[index, : each.steps + 1, : len(pairs)] = labels
    shapes = property_shapes(each.scene for each in trajectories)
    nodes = zip(*(pad_nodes(each.scene, capacity, shapes) for each in trajectories), strict=True)
    return TrajectoryBatch(
        position=position,
        velocity=velocity,
        control=control,
        contact=contact,
        nodes=Nodes._make(None if leaves[0] is None else np.stack(leaves) for leaves in nodes),
        steps=np.array([each.steps for each in trajectories]),
    )


def _check_turns(trajectory: Trajectory, position: np.ndarray, velocity: np.ndarray) -> None:
    """Raises `InvalidInputError` where a body with an outline has no orientation at some step."""
    for name, values in (("orientation", position), ("angular_velocity", velocity)):
        for node in np.flatnonzero(np.isnan(values).any(axis=(0, 2))):
            if trajectory.scene.outlines_of(int(node)):
                step = int(np.flatnonzero(np.isnan(values[:, node]).any(axis=1))[0])
                raise InvalidInputError(
                    f"{name} must be known of bodies with an outline, but that of "
                    f"{trajectory.scene.node_name[node]!r} is not at step {step}"
                )


def node_properties(scene: Scene) -> dict[str, np.ndarray]:
    """The `PROPERTIES` of a scene, without padding."""
    derived = {
        "type_id": np.array([type_id(name) for name in scene.node_type]),
        "outlines": _outlines(scene),
    }
    return {name: getattr(scene, name) for name in PROPERTIES if name not in derived} | derived


def _outlines(scene: Scene) -> np.ndarray:
    """[N, Q, V, …] m: see `Nodes.outlines`."""
    of_node = [scene.outlines_of(node) for node in range(scene.node_count)]
    if scene.dimension == 3:
        of_node = [list(map(hull_rows, each)) for each in of_node]
    every = [rows for each in of_node for rows in each]
    most = max(map(len, of_node), default=0), max(map(len, every), default=0)
    point = (5, 3) if scene.dimension == 3 else (scene.dimension,)
    outlines = np.zeros((len(of_node), *most, *point))
    for node, each in enumerate(of_node):
        for index, rows in enumerate(each):
            outlines[node, index:, : len(rows)] = rows
            outlines[node, index:, len(rows) :] = rows[-1]
    return outlines


def candidate_pairs(scene: Scene, node_capacity: int) -> np.ndarray:
    """[E] bool: which of the pairs of ``node_capacity`` nodes are candidate edges of a scene.

    A pair listed in either direction is one; a pair with padding is none. The capacity must be at
    least the scene's number of nodes.
    """
    pairs = pair_indices(node_capacity)
    candidate = pairs[:, 1] < scene.node_count  # the larger index of the two
    if scene.candidate_edges is not None:
        listed = np.zeros((node_capacity, node_capacity), dtype=bool)
        listed[scene.candidate_edges[:, 0], scene.candidate_edges[:, 1]] = True
        candidate &= (listed | listed.T)[pairs[:, 0], pairs[:, 1]]
    return candidate


def property_shapes(scenes: Iterable[Scene]) -> dict[str, tuple[int, ...]]:
    """The largest shape of each of the `PROPERTIES` that is given in some scene."""
    shapes: dict[str, tuple[int, ...]] = {}
    for scene in scenes:
        for name, value in node_properties(scene).items():
            # All components act on a node that alone is actuated.
            implied = name == "control_of" and scene.actuated.sum() <= 1
            if not PROPERTIES[name].is_absent(value) and not implied:
                shapes[name] = tuple(map(max, value.shape, shapes.get(name, value.shape)))
    return shapes


def pad_nodes(
    scene: Scene, capacity: int, shapes: dict[str, tuple[int, ...]] | None = None
) -> Nodes[np.ndarray]:
    """The nodes of a scene, padded to ``capacity``, with properties of these ``shapes``.

    The shapes are those of `property_shapes`, by default of this scene. Raises `InvalidInputError`
    where the scene has more nodes.
    """
    count = scene.node_count
    if capacity < count:
        raise InvalidInputError(f"node_capacity must be at least {count}, found {capacity}")
    shapes = property_shapes([scene]) if shapes is None else shapes
    own = node_properties(scene)
    if "control_of" in shapes and scene.control_of is None:
        own["control_of"] = np.repeat(scene.actuated[:, None], shapes["control_of"][1], axis=1)
    padded: dict[str, Any] = {}
    for name, shape in shapes.items():
        field = PROPERTIES[name]
        if field.axis[0] == "N":
            shape = (capacity, *shape[1:])
        value = own[name]
        more = [(0, size - least) for size, least in zip(shape, value.shape, strict=True)]
        if "V" in field.axis and value.size:  # Repeated corners and polygons change no outline.
            value = np.pad(value, [(0, 0), *more[1:]], mode="edge")
            more[1:] = [(0, 0)] * len(more[1:])
        padded[name] = np.pad(value.astype(field.kind), more, constant_values=field.padding)
    return Nodes(
        mask=np.arange(capacity) < count, candidate=candidate_pairs(scene, capacity), **padded
    )
