"""Convex bodies that turn: the points at which they meet, and what moves there.

A body is a union of convex polygons in the plane, of convex hulls of points in space; one without
an outline is a point, its centre, round which it has a radius. Candidates for a point of contact
are the vertices of each body against the facets of the other, and in space pairs of edges that
cross; among them are the nearest points of any two that do not overlap deeply (Ericson 2005,
*Real-Time Collision Detection*, chapter 5).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.convex import (
    across_edges,
    between,
    crossings,
    facet_distances,
    facets_of,
    vertices_of,
)
from contactgraph.bodies.geometry import Geometry
from contactgraph.bodies.rotations import across, levers, placed
from contactgraph.bodies.shapes import Meeting

_SAME_POINT, _SAME_NORMAL = 0.05, 0.9
"""Distance, in lengths, and cosine, of two points of contact that are one."""
_ON_FACE = 1e-4
"""Share by which the distance from a side may be more than the height above its line."""
_CROSSES = 0.02
"""In lengths: by how much a body may reach beyond an edge at which it meets another."""
_ROUNDING = 1e-5
"""Distance from a side, in its lengths, of which rounding leaves no direction."""
_FAR = 1e3
"""In lengths; the gap of a point that does not exist."""


def most_points(dimension: int) -> int:
    """Points of contact of two bodies, or of a body and a plane: as many as keep one from turning
    on the other, and in space as a face of a box has."""
    return 2 if dimension == 2 else 4


class ContactPoints(eqx.Module):
    """Points at which the two bodies of an edge are nearest to each other, the nearest first."""

    gap: Float[Array, "*C"]
    """m; below 0 where they overlap."""
    normal: Float[Array, "*C D"]
    """Unit vector from the first body to the second."""
    on_first: Float[Array, "*C D"]
    """m; the point of the first body."""
    on_second: Float[Array, "*C D"]
    """m"""
    on_face: Bool[Array, "*C"]
    """Whether one of them is a face, along which the other may slide without coming nearer."""


def polygon_meeting(
    outlines: Float[Array, "N P V ..."],
    position: Float[Array, "N G"],
    turns: Float[Array, " N"],
    edge_index: Int[Array, "2 E"],
    *,
    turn_length: float,
    length: float,
    margin: float = 0.0,
) -> Meeting:
    """The `contact_points` of every edge, a row each, the nearest of all edges first.

    ``turns`` is 1 for bodies that turn, else 0; ``turn_length`` see `generalized_coordinates`. The
    displacement ends at an outline as if that were the surface of a ball of half a ``length`` [m],
    less half a ``margin`` [m].
    """
    points = contact_points(placed(outlines, position, turn_length), edge_index, length)
    points = jax.tree.map(lambda leaf: leaf.swapaxes(0, 1).reshape(-1, *leaf.shape[2:]), points)
    ends = jnp.tile(edge_index, most_points(outlines.shape[-1]))
    corners = vertices_of(outlines).reshape(len(outlines), -1, outlines.shape[-1])
    extended = jnp.any(corners != corners[:, :1], axis=(1, 2))
    radius = 0.5 * (length - margin) * jnp.sum(extended[ends], axis=0)
    at_ends = jnp.stack([points.on_first, points.on_second])
    return Meeting(
        displacement=(points.gap + radius)[:, None] * points.normal,
        jacobian=levers(at_ends, position, turns, ends, turn_length),
        sliding=[points.on_face[:, None] * each for each in _tangents(points.normal)],
        edge_index=ends,
    )


def _tangents(normal: Float[Array, "C D"]) -> list[Float[Array, "C D"]]:
    """Unit vectors across each normal."""
    if normal.shape[-1] == 2:
        return [across(normal)]
    axis = jnp.eye(3, dtype=normal.dtype)[jnp.argmin(jnp.abs(normal), axis=-1)]
    first = jnp.cross(normal, axis)
    first = first / jnp.sqrt(jnp.sum(first**2, axis=-1, keepdims=True))
    return [first, jnp.cross(normal, first)]


def contact_points(
    outlines: Float[Array, "N P V ..."], edge_index: Int[Array, "2 E"], length: float
) -> ContactPoints:
    """The `most_points` points of contact of every edge, [E, points], of `placed` outlines.

    Points nearer to each other than a twentieth of ``length`` [m] count once.
    """
    if not edge_index.shape[1]:  # an empty array does not tell its other sizes
        of_one = contact_points(outlines, jnp.zeros((2, 1), int), length)
        return jax.tree.map(lambda leaf: leaf[:0], of_one)
    # Both ways: vertices of one body and the polygons of the other.
    ways = jnp.stack([edge_index, edge_index[::-1]], axis=1)
    bodies, dimension = outlines[ways], outlines.shape[-1]
    vertices, facets = vertices_of(bodies)[0], facets_of(bodies)[1]
    vertices = vertices.reshape(*vertices.shape[:2], -1, dimension)
    found = jax.lax.stop_gradient(_candidates(vertices, facets))
    apart, along, middle = (
        jnp.concatenate(list(leaf), axis=1) for leaf in (found.gap, found.normal, found.middle)
    )
    count = apart.shape[1]
    if dimension == 3:
        edges = bodies[0, ..., 3:, :].reshape(2, len(found.overlap), -1, 2, 3)
        given = bodies[0], found.overlap, _CROSSES * length
        crossing = jax.lax.stop_gradient(crossings(*given))
        # Else all that follows would compute them again for itself.
        both = jax.lax.optimization_barrier(((apart, along, middle), crossing))
        apart, along, middle = (jnp.concatenate(each, axis=1) for each in zip(*both, strict=True))
    chosen, exists = _nearest(apart, along, middle, length, most_points(dimension))
    rows = jnp.arange(edge_index.shape[1])[:, None]
    way, index = jnp.divmod(jnp.minimum(chosen, count - 1), count // 2)
    vertex, polygon = jnp.divmod(index, facets.shape[2])
    side, on_face = (
        jnp.concatenate(list(leaf), axis=1)[rows, way * (count // 2) + index]
        for leaf in (found.side, found.on_face)
    )
    corners = facets[way, rows, polygon, side]
    gap, normal, on_one, on_other = between(vertices[way, rows, vertex], corners, on_face)
    back = (way == 1)[..., None]
    result = ContactPoints(
        gap=gap,
        normal=jnp.where(back, -normal, normal),
        on_first=jnp.where(back, on_other, on_one),
        on_second=jnp.where(back, on_one, on_other),
        on_face=on_face,
    )
    if dimension == 3:
        first, second = jnp.divmod(jnp.maximum(chosen - count, 0), edges.shape[2])
        ends = edges[0, rows, first], edges[1, rows, second]
        crossed = ContactPoints(*across_edges(*ends, along[rows, chosen]), chosen >= count)
        result = jax.tree.map(
            lambda one, other: jnp.where(
                crossed.on_face.reshape(*chosen.shape, *(1,) * (one.ndim - 2)), other, one
            ),
            result,
            crossed,
        )
    gap = jnp.where(exists, result.gap, _FAR * length)
    return dataclasses.replace(result, gap=gap)


def as_near(points: Geometry, nearest: Geometry, tolerance: float) -> Float[Array, " C"]:
    """1 for points of contact that come as near as the nearest of their edge, or touch, else down
    to 0 within about a ``tolerance`` [m]; rows as of `EncodedGraph.contact_points`."""
    touch = jnp.maximum(nearest.closest_approach, nearest.contact_distance)
    count = len(points.distance) // max(1, len(touch))
    excess = jax.nn.relu(points.closest_approach - jnp.tile(touch, count))
    return jnp.exp(-((excess / tolerance) ** 2))


def plane_points(
    outlines: Float[Array, "N P V ..."], planes: Float[Array, "P D+1"], length: float
) -> tuple[Float[Array, "N P points"], Float[Array, "N P points D"]]:
    """The `most_points` lowest vertices of every body above every plane: heights and places, m.

    ``planes``: see `Nodes.planes`.
    """
    dimension = outlines.shape[-1]
    vertices = vertices_of(outlines).reshape(len(outlines), 1, -1, dimension)
    vertices = jnp.repeat(vertices, len(planes), axis=1)
    normal, offset = planes[:, None, :-1], planes[:, -1:]
    height = jnp.sum(vertices * normal, axis=-1) - offset
    flat = jax.lax.stop_gradient(height).reshape(-1, height.shape[2])
    places, count = vertices.reshape(*flat.shape, dimension), most_points(dimension)
    chosen, exists = (
        leaf.reshape(*height.shape[:2], count)
        for leaf in _nearest(flat, jnp.ones_like(places), places, length, count)
    )
    lowest = jnp.take_along_axis(vertices, chosen[..., None], axis=2)
    height = jnp.take_along_axis(height, chosen, axis=2)
    return jnp.where(exists, height, _FAR * length), lowest


def _nearest(
    gap: Float[Array, "E M"],
    normal: Float[Array, "E M D"],
    place: Float[Array, "E M D"],
    length: float,
    count: int,
) -> tuple[Int[Array, "E points"], Bool[Array, "E points"]]:
    """The candidates with the least gap that differ by place or normal, if there are ``count``."""
    left, chosen, exists = gap, [], []
    for _ in range(count):
        index = jnp.argmin(left, axis=1)[:, None]
        chosen.append(index)
        exists.append(jnp.take_along_axis(left, index, axis=1) < jnp.inf)
        at, along = (
            jnp.take_along_axis(each, index[..., None], axis=1) for each in (place, normal)
        )
        near = jnp.sum((place - at) ** 2, axis=-1) < (_SAME_POINT * length) ** 2
        alike = jnp.sum(normal * along, axis=-1) > _SAME_NORMAL
        left = jnp.where(near & alike, jnp.inf, left)
    return jnp.concatenate(chosen, axis=1), jnp.concatenate(exists, axis=1)


class _Candidates(eqx.Module):
    """Vertices of one body against the facets of the other, flattened."""

    gap: Float[Array, "ways E MP"]
    """Infinite where a vertex does not count."""
    side: Int[Array, "ways E MP"]
    on_face: Bool[Array, "ways E MP"]
    normal: Float[Array, "ways E MP D"]
    """From the first body of the edge to the second."""
    middle: Float[Array, "ways E MP D"]
    """m; between the two points."""
    overlap: Float[Array, " E"]
    """m; of the two bodies along the normal of a facet, below 0; above it where they are apart."""


def _candidates(
    vertices: Float[Array, "ways E M D"], facets: Float[Array, "ways E P V D D"]
) -> _Candidates:
    """Candidates both ways; a vertex of a body with an outline does not count against a point."""
    apart, height = facet_distances(vertices, facets)
    inside = jnp.all(height <= 0.0, axis=-1) & jnp.any(height > -jnp.inf, axis=-1)
    index = jnp.where(inside, jnp.argmax(height, axis=-1), jnp.argmin(apart, axis=-1))
    # Above a face the nearest point is inside of it, and the way there is its normal.
    begin, end = facets[:, :, None, ..., 0, :], facets[:, :, None, ..., 1, :]
    touches = apart < _ROUNDING**2 * jnp.sum((end - begin) ** 2, axis=-1)
    above = inside[..., None] | touches | (height > (1.0 - _ON_FACE) * jnp.sqrt(apart))
    on_face = jnp.take_along_axis(above, index[..., None], axis=-1)[..., 0]
    way, row, _, polygon = jnp.meshgrid(*map(jnp.arange, index.shape), indexing="ij")
    nearest = facets[way, row, polygon, index]
    gap, normal, on_one, on_other = between(vertices[:, :, :, None], nearest, on_face)
    extended = jnp.any(vertices != vertices[:, :, :1], axis=(2, 3))
    counts = jnp.arange(vertices.shape[2]) == 0
    counts = jnp.where(extended[..., None], extended[::-1, :, None], counts)
    forth = jnp.array([1.0, -1.0]).reshape(2, *(1,) * (normal.ndim - 1))

    def flat(leaf: Array) -> Array:
        return leaf.reshape(*leaf.shape[:2], -1, *leaf.shape[4:])

    return _Candidates(
        gap=flat(jnp.where(counts[..., None], gap, jnp.inf)),
        side=flat(index),
        on_face=flat(on_face),
        normal=flat(forth * normal),
        middle=flat(0.5 * (on_one + on_other)),
        overlap=jnp.max(jnp.min(height, axis=2), axis=(0, 2, 3)),
    )
