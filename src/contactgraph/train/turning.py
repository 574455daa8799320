"""Bodies that turn, as data show them: their types and inertia, and gaps between outlines."""

from collections.abc import Collection
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from contactgraph.bodies.polygons import contact_points
from contactgraph.bodies.rotations import placed
from contactgraph.data.dataset import Dataset
from contactgraph.data.graph import pair_indices, passive_nodes
from contactgraph.data.outlines import hull_moments, signed_area
from contactgraph.data.pins import pinned_group
from contactgraph.data.scene import Scene
from contactgraph.data.trajectory import Trajectory
from contactgraph.data.trajectory_batch import pad_nodes
from contactgraph.data.turns import generalized_coordinates

_NEAREST = 0.005
"""Share of the states that may lie nearer to a plane than a body that touches it."""
_TURNS = 1e-3
"""rad; by which a body must turn, so that it counts as one that does."""
_FAST, _LITTLE, _PARTS = 0.99, 0.1, 8
"""A quantile of the turns in a step of bodies on planes, rad; steps are in so many parts if it is
larger, since the places of contact turn with a body: with 16, tosses and rows of dominoes are
predicted no better, with 4 half as well."""


@dataclass(frozen=True)
class Turning:
    """What the data say of bodies that turn."""

    turn_length: float
    """m; their radius of gyration: see `generalized_coordinates`."""
    inertia: dict[str, np.ndarray]
    """Squared radius of gyration of each type that turns, of uniform density, in units of it; in
    space [3], about the axes of the body."""
    size: float
    """m; root of the area of the smallest polygon, or the cube root of a volume."""
    borne: frozenset[str]
    """Those of the types that lie or fall on planes, whose friction slows them."""
    substeps: int
    """Parts of a step in which those turn little; 1 where bodies are driven, since places within
    a step would depend on the control."""
    undriven: bool
    """Whether some types are borne by planes, and nothing is driven."""


def find_turning(dataset: Dataset) -> Turning | None:
    """None where no body has both an outline and an orientation that changes.

    Of passive bodies on planes, under gravity, any orientation will do: what holds them upright is
    their outline.
    """
    squares: dict[str, list[np.ndarray]] = {}
    sizes, borne, turns_in_step = [], set[str](), [np.zeros(1)]
    for each in dataset:
        if each.orientation is None or each.angular_velocity is None or not each.scene.polygons:
            return None
        turned = np.any(np.nan_to_num(np.ptp(_turns(each), axis=0)) > _TURNS, axis=-1)
        planes = each.scene.planes
        on_floor = each.scene.has_weight and planes is not None and len(planes) > 0
        if on_floor:
            rate = np.linalg.norm(each.angular_velocity, axis=-1)
            turns_in_step.append(each.scene.dt * rate.ravel())
            turned |= passive_nodes(each.scene)
        for node, name in enumerate(each.scene.node_type):
            moments = [_moments(outline) for outline in each.scene.outlines_of(node)]
            sizes += [size ** (1.0 / each.scene.dimension) for size, _ in moments]
            if moments and turned[node]:
                total = sum(size for size, _ in moments)
                whole = sum(size * square for size, square in moments) / total
                squares.setdefault(name, []).append(np.asarray(whole))
                borne |= {name} if on_floor and each.scene.dimension == 2 else set()
    if not squares:
        return None
    means = {name: np.mean(found, axis=0) for name, found in squares.items()}
    square = float(np.mean(list(means.values())))
    inertia = {name: found / square for name, found in means.items()}
    driven = any(each.scene.actuated.any() for each in dataset)
    fast = float(np.nanquantile(np.concatenate(turns_in_step), _FAST))
    substeps = _PARTS if fast > _LITTLE and not driven else 1
    return Turning(
        square**0.5,
        inertia,
        float(min(sizes)),
        frozenset(borne),
        substeps,
        undriven=bool(borne) and not driven,
    )


def _turns(trajectory: Trajectory) -> np.ndarray:
    """[T+1, N, 1 or 3] rad."""
    assert trajectory.orientation is not None and trajectory.angular_velocity is not None
    moved = generalized_coordinates(
        1.0,
        trajectory.position,
        trajectory.velocity,
        trajectory.orientation,
        trajectory.angular_velocity,
    )
    return moved[0][..., trajectory.scene.dimension :]


def _moments(outline: np.ndarray) -> tuple[float, np.ndarray]:
    """The area, m^2, and the squared radius of gyration, m^2, about the body's origin; in space the
    volume, m^3, and the three about its axes."""
    if outline.shape[1] == 3:
        return hull_moments(outline)
    following = np.roll(outline, -1, axis=0)
    cross = outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]
    squares = np.sum(outline**2 + outline * following + following**2, axis=1)
    area = signed_area(outline)
    return area, np.asarray(float(cross @ squares) / 12.0 / area)


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
    the radius of bodies without an outline; 0 of those that pins join."""
    round_ = ~has_outline(trajectory.scene)
    radii = np.add.outer(round_, round_) * 0.5 * contact_distance
    apart = outline_gaps(trajectory) - radii + contact_distance
    return np.where(_pinned(trajectory.scene), 0.0, apart)


def _pinned(scene: Scene) -> np.ndarray:
    """[N, N] bool: bodies that move each other though they do not touch."""
    return pinned_group(scene.pins, scene.node_count)


def round_distances(trajectory: Trajectory) -> np.ndarray:
    """[T+1, N, N] m: gaps of round bodies from others, in their diameters; infinite for others."""
    round_ = ~has_outline(trajectory.scene)
    count = np.add.outer(round_, round_)
    gaps = outline_gaps(trajectory)
    apart = (count == 0) | _pinned(trajectory.scene)
    return np.where(apart, np.inf, gaps * np.where(count == 1, 2.0, 1.0))


def plane_distances(dataset: Dataset, shaped: Collection[str]) -> dict[str, float]:
    """How near each type comes to any plane, m, but for the nearest of its states.

    Of a type that planes do not stop: how far it gets behind them, below 0. Outlines of the types
    ``shaped`` touch planes themselves; in space at the height at which they mostly are.
    """
    heights: dict[str, list[np.ndarray]] = {}
    planar = dataset.trajectories[0].scene.dimension == 2
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
            nearest[name] = min(near, 0.0) if planar else _densest(height)
    return nearest


def _densest(values: np.ndarray) -> float:
    """In the middle of the shortest interval that holds a tenth of the values."""
    values, count = np.sort(values), max(1, len(values) // 10)
    begin = int(np.argmin(values[count:] - values[:-count]))
    return float(0.5 * (values[begin] + values[begin + count]))


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
