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

from contactgraph.bodies.geometry import Meeting
from contactgraph.bodies.rotations import across, levers, placed

_SAME_POINT, _SAME_NORMAL = 0.05, 0.9
"""Distance, in lengths, and cosine, of two points of contact that are one."""
_ON_FACE = 1e-4
"""Share by which the distance from a side may be more than the height above its line."""
_CROSSES = 0.02
"""In lengths: by how much a body may reach beyond an edge at which it meets another."""
_ROUNDING = 1e-5
"""Distance from a side, in its lengths, of which rounding leaves no direction."""
FAR = 1e3
"""In lengths; the gap of a point that does not exist."""
_PARALLEL = 1e-3
"""Squared sine of the angle of two edges, below which they do not cross."""
_SMALL = 1e-12


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

    def seen_from_second(self) -> "ContactPoints":
        """The same with the two bodies exchanged."""
        return dataclasses.replace(
            self, normal=-self.normal, on_first=self.on_second, on_second=self.on_first
        )

    def where(self, condition: Bool[Array, "*C"], other: "ContactPoints") -> "ContactPoints":
        """These points where the condition holds, else the others."""

        def choose(one: Array, another: Array) -> Array:
            shape = *condition.shape, *(1,) * (one.ndim - condition.ndim)
            return jnp.where(condition.reshape(shape), one, another)

        return jax.tree.map(choose, self, other)


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
        contact_jacobian=levers(at_ends, position, turns, ends, turn_length),
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

    Points nearer to each other than a twentieth of ``length`` [m] count once. All candidates are
    compared without gradient; those chosen are found again with it.
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
    compared, count = (found.gap, found.normal, found.middle), found.gap.shape[1]
    if dimension == 3:
        crossing = _crossings(bodies[0], found.overlap, _CROSSES * length)
        # Else all that follows would compute them again for itself.
        both = jax.lax.optimization_barrier((compared, jax.lax.stop_gradient(crossing)))
        compared = jax.tree.map(lambda *each: jnp.concatenate(each, axis=1), *both)
    chosen, exists = nearest_places(*compared, length, most_points(dimension))
    rows = jnp.arange(edge_index.shape[1])[:, None]
    index = jnp.minimum(chosen, count - 1)
    way, place = jnp.divmod(index, count // 2)
    vertex, polygon = jnp.divmod(place, facets.shape[2])
    corners = facets[way, rows, polygon, found.side[rows, index]]
    result = _between(vertices[way, rows, vertex], corners, found.on_face[rows, index])
    result = result.seen_from_second().where(way == 1, result)
    if dimension == 3:
        first, second = _edges_of(bodies[0])
        one, other = jnp.divmod(jnp.maximum(chosen - count, 0), first.shape[1])
        crossed, *_ = _crossing(first[rows, one], second[rows, other], compared[1][rows, chosen])
        result = crossed.where(chosen >= count, result)
    gap = jnp.where(exists, result.gap, FAR * length)
    return dataclasses.replace(result, gap=gap)


def nearest_places(
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


def vertices_of(outlines: Float[Array, "... D"]) -> Float[Array, "... D"]:
    """[..., V, D]: see `Nodes.outlines`."""
    return outlines if outlines.shape[-1] == 2 else outlines[..., 3, :]


def facets_of(outlines: Float[Array, "... D"]) -> Float[Array, "... D"]:
    """[..., V, D, D]: the ends of each side of polygons, the corners of each triangle of hulls."""
    if outlines.shape[-1] == 3:
        return outlines[..., :3, :]
    return jnp.stack([outlines, jnp.roll(outlines, -1, axis=-2)], axis=-2)


class _Candidates(eqx.Module):
    """Vertices of each body against the facets of the other, those of the first body first."""

    gap: Float[Array, "E M"]
    """Infinite where a vertex does not count."""
    side: Int[Array, "E M"]
    on_face: Bool[Array, "E M"]
    normal: Float[Array, "E M D"]
    """From the first body of the edge to the second."""
    middle: Float[Array, "E M D"]
    """m; between the two points."""
    overlap: Float[Array, " E"]
    """m; of the two bodies along the normal of a facet, below 0; above it where they are apart."""


def _candidates(
    vertices: Float[Array, "ways E M D"], facets: Float[Array, "ways E P V D D"]
) -> _Candidates:
    """Candidates both ways; a vertex of a body with an outline does not count against a point."""
    seen = vertices[:, :, :, None]
    square, height, *_ = _from_facet(seen[..., None, :], facets[:, :, None])
    inside = jnp.all(height <= 0.0, axis=-1) & jnp.any(height > -jnp.inf, axis=-1)
    index = jnp.argmin(square, axis=-1)
    index = jnp.where(inside, jnp.argmax(height, axis=-1), index)
    # Above a face the nearest point is inside of it, and the way there is its normal.
    begin, end = facets[:, :, None, ..., 0, :], facets[:, :, None, ..., 1, :]
    touches = square < _ROUNDING**2 * jnp.sum((end - begin) ** 2, axis=-1)
    touches |= height > (1.0 - _ON_FACE) * jnp.sqrt(square)
    above = inside[..., None] | touches
    on_face = jnp.take_along_axis(above, index[..., None], axis=-1)[..., 0]
    way, row, _, polygon = jnp.meshgrid(*map(jnp.arange, index.shape), indexing="ij")
    points = _between(seen, facets[way, row, polygon, index], on_face)
    extended = jnp.any(vertices != vertices[:, :, :1], axis=(2, 3))
    counts = jnp.arange(vertices.shape[2]) == 0
    counts = jnp.where(extended[..., None], extended[::-1, :, None], counts)
    forth = jnp.array([1.0, -1.0]).reshape(2, *(1,) * (points.normal.ndim - 1))

    def flat(leaf: Array) -> Array:
        return jnp.moveaxis(leaf, 0, 1).reshape(leaf.shape[1], -1, *leaf.shape[4:])

    return _Candidates(
        gap=flat(jnp.where(counts[..., None], points.gap, jnp.inf)),
        side=flat(index),
        on_face=flat(on_face),
        normal=flat(forth * points.normal),
        middle=flat(0.5 * (points.on_first + points.on_second)),
        overlap=jnp.max(jnp.min(height, axis=2), axis=(0, 2, 3)),
    )


def _from_facet(
    point: Float[Array, "*C D"], corners: Float[Array, "*C D D"]
) -> tuple[Float[Array, "*C"], Float[Array, "*C"], "_Vector", "_Vector"]:
    """The squared distance of a point from a facet, its height above the line or plane of that, m,
    the way to it from the nearest point, m, and the facet's normal.

    A facet is a side of a polygon or a triangle of a hull, counter-clockwise seen from outside. One
    without extent has the normal 0, and all points are infinitely far below it.
    """
    at, in_space = _Vector.of(point), corners.shape[-1] == 3
    ends = [_Vector.of(corners[..., each, :]) for each in range(corners.shape[-1])]
    sides = [ends[(each + 1) % len(ends)] - end for each, end in enumerate(ends)]
    area = sides[0].cross(sides[1]) if in_space else _Vector((sides[0][1], -sides[0][0]))
    extent = area.dot(area)
    outward = area.times(_inverse_root(extent))
    height = (at - ends[0]).dot(outward)
    above = (extent > 0.0) & in_space  # the triangle, not only its plane
    square, away = jnp.full_like(height, jnp.inf), at
    for end, side in zip(ends, sides if in_space else sides[:1], strict=False):
        offset = at - end
        if in_space:
            above = above & (outward.cross(side).dot(offset) >= 0.0)
        part = jnp.clip(offset.dot(side) * _inverse(side.dot(side)), 0.0, 1.0)
        way = offset - side.times(part)
        apart = way.dot(way)
        square, away = jnp.minimum(square, apart), way.where(apart < square, away)
    square, away = jnp.where(above, height**2, square), outward.times(height).where(above, away)
    return square, jnp.where(extent > 0.0, height, -jnp.inf), away, outward


def _between(
    point: Float[Array, "*C D"], corners: Float[Array, "*C D D"], on_face: Bool[Array, "*C"]
) -> ContactPoints:
    """Of a point of the first body and a facet of the second.

    ``on_face``: the gap is the height above the line or plane of the facet, below 0 behind it.
    """
    _, height, away, outward = _from_facet(point, corners)
    apart = jnp.sqrt(away.dot(away) + _SMALL)
    gap = jnp.where(on_face, height, apart)
    normal = -outward.where(on_face, away.times(1.0 / apart)).stacked()
    whole = jnp.broadcast_to(point, normal.shape)
    return ContactPoints(gap, normal, whole, whole + gap[..., None] * normal, on_face)


def _crossing(
    first: Float[Array, "*C 2 3"], second: Float[Array, "*C 2 3"], outward: Float[Array, "*C 3"]
) -> tuple[ContactPoints, Float[Array, "2 ..."], Float[Array, "*C"]]:
    """The nearest points of the lines of two edges with these ends, and the normal along
    ``outward``; at which part of each edge its point lies; and the squared sine of their angle.

    Each point counts as a face, along which nothing comes nearer.
    """
    begin, start = (_Vector.of(each[..., 0, :]) for each in (first, second))
    one, other = (_Vector.of(each[..., 1, :] - each[..., 0, :]) for each in (first, second))
    area, offset = one.cross(other), start - begin
    square = area.dot(area)
    ahead = jnp.where(area.dot(_Vector.of(outward)) < 0.0, -1.0, 1.0)
    normal = area.times(ahead * _inverse_root(square))
    part, share = (offset.cross(each).dot(area) * _inverse(square) for each in (other, one))
    points = ContactPoints(
        gap=normal.dot(offset),
        normal=normal.stacked(),
        on_first=(begin + one.times(part)).stacked(),
        on_second=(start + other.times(share)).stacked(),
        on_face=jnp.ones(square.shape, bool),
    )
    slant = square * _inverse(one.dot(one) * other.dot(other))
    return points, jnp.stack([part, share]), slant


def _edges_of(hulls: Float[Array, "2 E P V 5 3"]) -> Float[Array, "2 E M 2 3"]:
    """The ends of all edges of each body."""
    return hulls[..., 3:, :].reshape(2, hulls.shape[1], -1, 2, 3)


def _crossings(
    hulls: Float[Array, "2 E P V 5 3"], overlap: Float[Array, " E"], tolerance: float
) -> tuple[Float[Array, "E M"], Float[Array, "E M 3"], Float[Array, "E M 3"]]:
    """Gap, infinite where they do not meet, normal and middle of all pairs of edges of two bodies.

    Edges meet where both bodies lie behind them, but for a ``tolerance`` [m]. They do not where the
    bodies would have to part by more than along the normal of a face, by ``overlap`` [m] below 0.
    """
    edges = _edges_of(hulls)
    # The corners of each edge's own hull, [V, E, M, 3].
    own = jnp.moveaxis(jnp.repeat(hulls[..., 3, :], hulls.shape[3], axis=2), 3, 1)
    outward = jnp.mean(edges[0], axis=2) - jnp.mean(own[0], axis=0)
    first, second = edges[0][:, :, None], edges[1][:, None]
    points, parts, slant = _crossing(first, second, outward[:, :, None])
    gap, normal = points.gap, _Vector.of(points.normal)
    meets = slant > _PARALLEL
    meets &= jnp.all((parts > 0.0) & (parts < 1.0), axis=0)
    meets &= gap > overlap[:, None, None] - tolerance
    for end, sign, at in ((0, 1.0, first), (1, -1.0, second)):
        corners = _Vector.of(jnp.expand_dims(own[end], 3 - end))
        behind = jnp.max(sign * corners.dot(normal), axis=0)
        behind -= sign * normal.dot(_Vector.of(at[..., 0, :]))
        meets &= behind < tolerance
    middle = 0.5 * (points.on_first + points.on_second)
    flat = len(gap), -1
    gap = jnp.where(meets, gap, jnp.inf).reshape(flat)
    return gap, points.normal.reshape(*flat, 3), middle.reshape(*flat, 3)


def _inverse(square: Float[Array, "*C"]) -> Float[Array, "*C"]:
    """0 of 0."""
    return jnp.where(square > 0.0, 1.0 / jnp.where(square > 0.0, square, 1.0), 0.0)


def _inverse_root(square: Float[Array, "*C"]) -> Float[Array, "*C"]:
    """0 of 0."""
    inverse = 1.0 / jnp.where(square > 0.0, square, 1.0)
    return jnp.where(square > 0.0, jnp.sqrt(inverse), 0.0)


class _Vector(tuple[Array, ...]):
    """The components of vectors: sums over a last axis of three take ten times as long."""

    @classmethod
    def of(cls, vector: Float[Array, "*C D"]) -> "_Vector":
        return cls(vector[..., each] for each in range(vector.shape[-1]))

    def stacked(self) -> Float[Array, "*C D"]:
        return jnp.stack(self, axis=-1)

    def __add__(self, other: "_Vector") -> "_Vector":  # type: ignore[override]
        return _Vector(a + b for a, b in zip(self, other, strict=True))

    def __sub__(self, other: "_Vector") -> "_Vector":
        return _Vector(a - b for a, b in zip(self, other, strict=True))

    def times(self, factor: Array) -> "_Vector":
        return _Vector(factor * each for each in self)

    def where(self, condition: Array, other: "_Vector") -> "_Vector":
        return _Vector(jnp.where(condition, a, b) for a, b in zip(self, other, strict=True))

    def dot(self, other: "_Vector") -> Array:
        products = [a * b for a, b in zip(self, other, strict=True)]
        return sum(products[1:], products[0])

    def cross(self, other: "_Vector") -> "_Vector":
        (x, y, z), (u, v, w) = self, other
        return _Vector((y * w - z * v, z * u - x * w, x * v - y * u))
