"""Shapes of bodies as data show them: how near they touch, which of them turn, and gaps."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from contactgraph.bodies.polygons import contact_points
from contactgraph.bodies.rotations import placed
from contactgraph.data.dataset import Dataset
from contactgraph.data.graph import joined, pair_indices
from contactgraph.data.outlines import outline_moments
from contactgraph.data.padding import pad_nodes
from contactgraph.data.trajectory import Scene, Trajectory, box_distance
from contactgraph.data.turns import rotation_vectors
from contactgraph.model.presets import ModelConfig

CONTACT_DISTANCE = 0.085
"""m; where data do not tell, about the distance at which bodies touch."""
_MOVES, _LEAST_BEGINNINGS = 0.02, 10
"""Share of a trajectory's greatest speed from which a body moves; and how often that must begin for
the distance of contact to be seen from it."""
_FARTHER = 0.9
"""Quantile of these distances: of bodies that are no discs, most touch when they are nearer."""
_SAME = 0.01
"""Spread of these distances from which training learns the distance: impacts would lead away."""
_NEAREST = 0.005
"""Share of the states that may lie nearer to a plane than a body that touches it."""
_TURNS = 1e-3
"""rad; by which a body must turn, so that it counts as one that does."""
_FAST, _LITTLE, _PARTS = 0.99, 0.1, 8
"""A quantile of the turns in a step of bodies on planes, rad; steps are in so many parts if it is
larger, since the places of contact turn with a body: with 16, tosses and rows of dominoes are
predicted no better, with 4 half as well."""


def with_shapes(config: ModelConfig, dataset: Dataset) -> ModelConfig:
    """With what the motion of bodies tells of their shapes: how near they touch, where that is
    learned, and which of them turn."""
    config = with_turning(config, dataset)
    if not config.learned_contact_distance:
        return config
    if config.inertia and not all_outlined(dataset):
        return replace(config, contact_distance=_touching(dataset, round_distances)[0])
    if config.inertia:
        # Outlines touch where they meet, and bodies at rest tell nothing else.
        sizes = (
            outline_moments(outline)[0] ** (1.0 / dataset.dimension)
            for each in dataset
            for node in range(each.scene.node_count)
            for outline in each.scene.outlines_of(node)
        )
        config = replace(config, contact_distance=min(sizes), learned_contact_distance=False)
        if dataset.dimension == 2:
            return config
        margin = _touching(dataset, distances(config))[0] - config.contact_distance
        return replace(config, margin=margin)
    round_, box = (
        _touching(dataset, partial(centre_distances, boxes=each)) for each in (False, True)
    )
    # Shapes that are right let bodies touch at one distance.
    boxes = box[1] < round_[1]
    distance, spread = box if boxes else round_
    learned = spread >= _SAME
    return replace(config, contact_distance=distance, learned_contact_distance=learned, boxes=boxes)


def distances(config: ModelConfig) -> Callable[[Trajectory], np.ndarray]:
    """[T+1, N, N] m of a trajectory: of bodies from each other, so that they touch at
    `ModelConfig.contact_distance`; infinite of a body from itself."""
    if config.inertia:
        return partial(outline_distances, contact_distance=config.contact_distance)
    return partial(centre_distances, boxes=config.boxes)


def _touching(
    dataset: Dataset, distances: Callable[[Trajectory], np.ndarray]
) -> tuple[float, float]:
    """The distance from the nearest body at which bodies that rest begin to move, m, and its spread
    from the first to the last tenth, in units of it; infinite where not known.

    Where that is hardly ever seen: how near bodies come to each other in some trajectories.
    ``distances`` [T+1, N, N] m are those of a trajectory.
    """
    if any(each.scene.hinged.any() for each in dataset):
        return CONTACT_DISTANCE, np.inf  # is that from a bar's middle line
    begins, nearest = [np.zeros(0)], []
    for each in dataset:
        apart = np.min(distances(each), axis=-1)
        if not np.isfinite(apart).any():
            continue  # of one body, or of outlines alone
        speed = np.linalg.norm(each.velocity, axis=-1)
        moves = speed > _MOVES * speed.max(initial=0.0)
        begin = ~moves[:-1] & moves[1:] & ~each.scene.actuated
        begins.append(np.minimum(apart[:-1], apart[1:])[begin])
        nearest.append(float(apart.min()))
    found, share, spread = np.concatenate(begins), _FARTHER, np.inf
    if len(found) < _LEAST_BEGINNINGS:
        found, share = np.array(nearest), 1.0 - _FARTHER
    elif (middle := float(np.median(found))) > 0.0:
        low, high = np.quantile(found, [1.0 - _FARTHER, _FARTHER])
        spread = float(high - low) / middle
    distance = float(np.quantile(found, share)) if len(found) else 0.0
    return (distance if distance > 0.0 else CONTACT_DISTANCE), spread


def with_turning(config: ModelConfig, dataset: Dataset) -> ModelConfig:
    """With the types of bodies that turn: those that have both an outline and an orientation that
    changes.

    Of passive bodies on planes, under gravity, any orientation will do: what holds them upright is
    their outline.
    """
    squares: dict[str, list[np.ndarray]] = {}
    turns_in_step = [np.zeros(1)]
    for each in dataset:
        scene = each.scene
        turning = each.orientation, each.angular_velocity
        if not scene.polygons or any(np.isnan(known).all() for known in turning):
            return config
        turned = np.any(np.nan_to_num(np.ptp(_turns(each), axis=0)) > _TURNS, axis=-1)
        if on_planes(scene):
            rate = np.linalg.norm(each.angular_velocity, axis=-1)
            turns_in_step.append(scene.dt * rate.ravel())
            turned |= scene.passive
        for node in np.flatnonzero(turned & scene.outlined).tolist():
            moments = [outline_moments(outline) for outline in scene.outlines_of(node)]
            total = sum(size for size, _ in moments)
            whole = sum(size * square for size, square in moments) / total
            squares.setdefault(scene.node_type[node], []).append(np.asarray(whole))
    if not squares:
        return config
    means = {name: np.mean(found, axis=0) for name, found in squares.items()}
    square = float(np.mean(list(means.values())))
    fast = float(np.nanquantile(np.concatenate(turns_in_step), _FAST))
    driven = any(each.scene.actuated.any() for each in dataset)
    return replace(
        config,
        turn_length=square**0.5,
        inertia={name: found / square for name, found in means.items()},
        # Of driven bodies places within a step would depend on the control.
        substeps=_PARTS if fast > _LITTLE and not driven else 1,
    )


def _turns(trajectory: Trajectory) -> np.ndarray:
    """[T+1, N, 1 or 3] rad."""
    turn = trajectory.orientation
    return turn if trajectory.scene.dimension == 2 else rotation_vectors(turn)


def centre_distances(trajectory: Trajectory, boxes: bool) -> np.ndarray:
    """[T+1, N, N] m: between the centres of bodies, of themselves infinite.

    ``boxes``: those that have a size are boxes, see `box_distance`.
    """
    offset = trajectory.position[:, :, None] - trajectory.position[:, None]
    half = trajectory.scene.half_size * boxes
    return box_distance(offset, half[:, None] + half) + np.diag(
        np.full(trajectory.scene.node_count, np.inf)
    )


def outline_gaps(trajectory: Trajectory) -> np.ndarray:
    """[T+1, N, N] m: between the outlines of bodies, or the centres of those that have none; below
    0 where they overlap, and infinite of a body from itself."""
    scene = trajectory.scene
    count = scene.node_count
    gaps = np.full((len(trajectory.position), count, count), np.inf)
    pairs = pair_indices(count)
    if len(pairs):
        outlines = jnp.asarray(pad_nodes(scene, count).outlines)
        position = np.concatenate([trajectory.position, np.nan_to_num(_turns(trajectory))], axis=-1)
        found = _gaps(outlines, jnp.asarray(position), jnp.asarray(pairs.T))
        gaps[:, pairs[:, 0], pairs[:, 1]] = gaps[:, pairs[:, 1], pairs[:, 0]] = found
    return gaps


@jax.jit
def _gaps(outlines: Array, position: Array, edge_index: Array) -> Array:
    def at(position: Array) -> Array:
        return contact_points(placed(outlines, position, 1.0), edge_index, 1.0).gap[:, 0]

    return jax.lax.map(at, position)


def outline_distances(trajectory: Trajectory, contact_distance: float) -> np.ndarray:
    """[T+1, N, N] m: the gaps, as of round bodies that touch at ``contact_distance``, whose half is
    the radius of bodies without an outline; 0 of those that pins join, which move each other."""
    scene = trajectory.scene
    round_ = ~scene.outlined
    radii = np.add.outer(round_, round_) * 0.5 * contact_distance
    apart = outline_gaps(trajectory) - radii + contact_distance
    return np.where(pinned_group(scene), 0.0, apart)


def round_distances(trajectory: Trajectory) -> np.ndarray:
    """[T+1, N, N] m: gaps of round bodies from others, in their diameters; infinite for others."""
    scene = trajectory.scene
    round_ = ~scene.outlined
    count = np.add.outer(round_, round_)
    apart = (count == 0) | pinned_group(scene)
    return np.where(apart, np.inf, outline_gaps(trajectory) * np.where(count == 1, 2.0, 1.0))


def plane_distances(dataset: Dataset, shaped: Collection[str]) -> dict[str, float]:
    """How near each type comes to any plane, m, but for the nearest of its states.

    Of a type that planes do not stop: how far it gets behind them, below 0. Outlines of the types
    ``shaped`` touch planes themselves; in space at the height at which they mostly are.
    """
    heights: dict[str, list[np.ndarray]] = {}
    for each in dataset:
        if len(each.scene.planes):
            height = plane_heights(each, outlines=bool(shaped))
            for node, name in enumerate(each.scene.node_type):
                heights.setdefault(name, []).append(height[:, node])
    nearest: dict[str, float] = {}
    for name, found in heights.items():
        height = np.concatenate(found)
        near = float(np.quantile(height, _NEAREST))
        nearest[name] = near if near > 0.0 else float(height.min())
        if name in shaped:
            nearest[name] = min(near, 0.0) if dataset.dimension == 2 else _densest(height)
    return nearest


def _densest(values: np.ndarray) -> float:
    """In the middle of the shortest interval that holds a tenth of the values."""
    values, count = np.sort(values), max(1, len(values) // 10)
    begin = int(np.argmin(values[count:] - values[:-count]))
    return float(0.5 * (values[begin] + values[begin + count]))


def plane_heights(trajectory: Trajectory, outlines: bool) -> np.ndarray:
    """[T+1, N] m: of a body's centre above any plane, or of the lowest point of its outline."""
    scene, position = trajectory.scene, trajectory.position
    normal, offset = scene.planes[:, :-1].T, scene.planes[:, -1]
    heights = position @ normal - offset
    for node in np.flatnonzero(outlines & scene.outlined).tolist():
        vertices = np.concatenate(trajectory.outlines_of(node), axis=1)
        heights[:, node] = np.min(vertices @ normal - offset, axis=1)
    return np.asarray(heights.min(axis=-1))


def all_outlined(dataset: Dataset) -> bool:
    """Whether the outlines of all nodes are given."""
    return all(each.scene.outlined.all() for each in dataset)


def on_planes(scene: Scene) -> bool:
    """Whether bodies lie on planes, or fall on them."""
    return scene.has_weight and len(scene.planes) > 0


def pinned_group(scene: Scene) -> np.ndarray:
    """[N, N] bool: whether pins join two nodes, directly or through others; False of a node with
    itself."""
    itself = np.eye(scene.node_count, dtype=bool)
    first, second = scene.pins.T
    pinned = np.zeros_like(itself)
    pinned[first, second] = pinned[second, first] = True
    return (joined(pinned[None])[0] > 0.0) & ~itself


def pinned_motion(
    velocity: np.ndarray, group: np.ndarray, node_type: Sequence[str], names: Sequence[str]
) -> np.ndarray:
    """[T, D, 2K] m/s: changes of velocity, then velocities [T+1, N, D], summed over the bodies of
    each of the K types ``names`` in a ``group`` [N]; forces at pins cancel in their momentum."""
    both = np.diff(velocity, axis=0), velocity[:-1]
    alike = [group & (np.array(node_type) == name) for name in names]
    sums = [each[:, of].sum(axis=1) for each in both for of in alike]
    return np.stack(sums, axis=-1) if sums else np.zeros((*both[0][:, 0].shape, 0))
