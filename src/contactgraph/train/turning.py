"""Bodies that turn, as data show them: their types and inertia, and gaps between outlines."""

import math
from collections.abc import Collection
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from contactgraph.data.dataset import Dataset
from contactgraph.data.graph import pair_indices, passive_nodes
from contactgraph.data.scene import Scene, signed_area
from contactgraph.data.trajectory import Trajectory
from contactgraph.data.trajectory_batch import pad_nodes
from contactgraph.model.polygons import contact_points, placed

_NEAREST = 0.005
"""Share of the states that may lie nearer to a plane than a body that touches it."""
_TURNS = 1e-3
"""rad; by which a body must turn, so that it counts as one that does."""
_FAST, _LITTLE = 0.99, 0.1
"""Quantile of turns in a step of bodies on planes, and that in each of its parts, rad: where a body
touches turns with it."""


@dataclass(frozen=True)
class Turning:
    """What the data say of bodies that turn."""

    turn_length: float
    """m; their radius of gyration: see `generalized_coordinates`."""
    inertia: dict[str, float]
    """Squared radius of gyration of each type that turns, of uniform density, in units of it."""
    size: float
    """m; root of the area of the smallest polygon."""
    borne: frozenset[str]
    """Those of the types that lie or fall on planes, whose friction slows them."""
    substeps: int
    """Parts of a step in which those turn little; 1 where bodies are driven, since places within
    a step would depend on the control."""


def find_turning(dataset: Dataset) -> Turning | None:
    """None where no body has both an outline and an orientation that changes.

    Of passive bodies on planes, under gravity, any orientation will do: what holds them upright is
    their outline.
    """
    squares: dict[str, list[float]] = {}
    areas, borne, turns_in_step = [], set[str](), [np.zeros(1)]
    for each in dataset:
        if each.orientation is None or each.angular_velocity is None or not each.scene.polygons:
            return None
        turns = np.nan_to_num(np.ptp(each.orientation[..., 0], axis=0)) > _TURNS
        on_floor = _has_floor(each.scene)
        if on_floor:
            turns_in_step.append(np.abs(each.scene.dt * each.angular_velocity).ravel())
            turns |= passive_nodes(each.scene)
        for node, name in enumerate(each.scene.node_type):
            outlines = each.scene.outlines_of(node)
            areas += [signed_area(outline) for outline in outlines]
            if outlines and turns[node]:
                squares.setdefault(name, []).append(_gyration_square(outlines))
                borne |= {name} if on_floor else set()
    if not squares:
        return None
    means = {name: float(np.mean(found)) for name, found in squares.items()}
    square = float(np.mean(list(means.values())))
    inertia = {name: found / square for name, found in means.items()}
    driven = any(each.scene.actuated.any() for each in dataset)
    fast = float(np.nanquantile(np.concatenate(turns_in_step), _FAST))
    substeps = 1 if driven else max(1, math.ceil(fast / _LITTLE))
    size = float(min(areas)) ** 0.5
    return Turning(square**0.5, inertia, size, frozenset(borne), substeps)


def _has_floor(scene: Scene) -> bool:
    return scene.has_weight and scene.planes is not None and len(scene.planes) > 0


def _gyration_square(outlines: list[np.ndarray]) -> float:
    """m^2, about the body's origin: the polar second moment of area over the area."""
    total = moment = 0.0
    for outline in outlines:
        following = np.roll(outline, -1, axis=0)
        cross = outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]
        squares = np.sum(outline**2 + outline * following + following**2, axis=1)
        total, moment = total + float(np.sum(cross)) / 2.0, moment + float(cross @ squares) / 12.0
    return moment / total


def outline_gaps(trajectory: Trajectory) -> np.ndarray:
    """[T+1, N, N] m: between the outlines of bodies, or the centres of those that have none; below
    0 where they overlap, and infinite of a body from itself."""
    scene, orientation = trajectory.scene, trajectory.orientation
    assert orientation is not None
    count = scene.node_count
    gaps = np.full((len(trajectory.position), count, count), np.inf)
    pairs = pair_indices(count)
    if len(pairs):
        outlines = jnp.asarray(pad_nodes(scene, count).outlines)
        angle = jnp.asarray(np.nan_to_num(orientation[..., 0]))
        found = _gaps(outlines, jnp.asarray(trajectory.position), angle, jnp.asarray(pairs.T))
        gaps[:, pairs[:, 0], pairs[:, 1]] = gaps[:, pairs[:, 1], pairs[:, 0]] = found
    return gaps


@jax.jit
def _gaps(outlines: Array, position: Array, angle: Array, edge_index: Array) -> Array:
    def at(position: Array, angle: Array) -> Array:
        return contact_points(placed(outlines, position, angle), edge_index, 1.0).gap[:, 0]

    return jax.vmap(at)(position, angle)


def outline_distances(trajectory: Trajectory, contact_distance: float) -> np.ndarray:
    """[T+1, N, N] m: the gaps, as of round bodies that touch at ``contact_distance``, whose half is
    the radius of bodies without an outline."""
    round_ = ~has_outline(trajectory.scene)
    radii = np.add.outer(round_, round_) * 0.5 * contact_distance
    return outline_gaps(trajectory) - radii + contact_distance


def round_distances(trajectory: Trajectory) -> np.ndarray:
    """[T+1, N, N] m: gaps of round bodies from others, in their diameters; infinite for others."""
    round_ = ~has_outline(trajectory.scene)
    count = np.add.outer(round_, round_)
    gaps = outline_gaps(trajectory)
    return np.where(count == 0, np.inf, gaps * np.where(count == 1, 2.0, 1.0))


def plane_distances(dataset: Dataset, shaped: Collection[str]) -> dict[str, float]:
    """How near each type comes to any plane, m, but for the nearest of its states.

    Of a type that planes do not stop: how far it gets behind them, below 0. Outlines of the types
    ``shaped`` touch planes themselves.
    """
    heights: dict[str, list[np.ndarray]] = {}
    for each in dataset:
        planes = each.scene.planes
        if planes is not None and len(planes):
            of_centres = each.position @ planes[:, :-1].T - planes[:, -1]
            height = plane_heights(each) if shaped else np.min(of_centres, axis=-1)
            for node, name in enumerate(each.scene.node_type):
                heights.setdefault(name, []).append(height[:, node])
    nearest: dict[str, float] = {}
    for name, found in heights.items():
        height = np.concatenate(found)
        near = float(np.quantile(height, _NEAREST))
        nearest[name] = near if near > 0.0 else float(height.min())
        if name in shaped:
            nearest[name] = min(near, 0.0)
    return nearest


def plane_heights(trajectory: Trajectory) -> np.ndarray:
    """[T+1, N] m: of the lowest point of a body's outline, or its centre, above any plane."""
    scene, position = trajectory.scene, trajectory.position
    assert scene.planes is not None
    normal, offset = scene.planes[:, :-1].T, scene.planes[:, -1]
    heights = position @ normal - offset
    for node in np.flatnonzero(has_outline(scene)).tolist():
        vertices = np.concatenate(trajectory.outlines_of(node), axis=1)
        heights[:, node] = np.min(vertices @ normal - offset, axis=1)
    return np.asarray(heights.min(axis=-1))


def has_outline(scene: Scene) -> np.ndarray:
    """[N] bool: the nodes of which an outline is given."""
    return np.array([bool(scene.outlines_of(node)) for node in range(scene.node_count)])
