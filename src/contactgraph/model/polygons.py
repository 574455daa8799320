"""Bodies of convex polygons that turn in the plane: their nearest features, and what moves there.

A body is a union of convex polygons; one without an outline is a point, its centre, round which it
has a radius. The candidates for a point of contact are the vertices of each body against the
polygons of the other, which in the plane contain the nearest points of any two that do not overlap
deeply (Ericson 2005, *Real-Time Collision Detection*, chapter 5).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.model.collision import Geometry
from contactgraph.model.shapes import Meeting

POINTS = 2
"""Points of contact of two bodies, or of a body and a plane: in the plane as many as keep two
bodies from turning against each other."""
_SMALL = 1e-12
_SAME_POINT, _SAME_NORMAL = 0.05, 0.9
"""Distance, in lengths, and cosine, of two points of contact that are one."""
_ON_FACE = 1e-4
"""Share by which the distance from a side may be more than the height above its line."""
_ROUNDING = 1e-5
"""Distance from a side, in its lengths, of which rounding leaves no direction."""
_FAR = 1e3
"""In lengths; the gap of a point that does not exist."""


class ContactPoints(eqx.Module):
    """Points at which the two bodies of an edge are nearest to each other, the nearest first."""

    gap: Float[Array, "*C"]
    """m; below 0 where they overlap."""
    normal: Float[Array, "*C 2"]
    """Unit vector from the first body to the second."""
    on_first: Float[Array, "*C 2"]
    """m; the point of the first body."""
    on_second: Float[Array, "*C 2"]
    """m"""
    on_face: Bool[Array, "*C"]
    """Whether one of them is a face, along which the other may slide without coming nearer."""


def polygon_meeting(
    outlines: Float[Array, "N P V 2"],
    position: Float[Array, "N 3"],
    turns: Float[Array, " N"],
    edge_index: Int[Array, "2 E"],
    turn_length: float,
    length: float,
) -> Meeting:
    """The `contact_points` of every edge, [POINTS * E] rows, the nearest of all edges first.

    ``turns`` is 1 for bodies that turn, else 0; ``turn_length`` see `generalized_coordinates`. The
    displacement ends at an outline as if that were the surface of a ball of half a ``length`` [m].
    """
    shapes = placed(outlines, position[:, :2], position[:, 2] / turn_length)
    points = contact_points(shapes, edge_index, length)
    points = jax.tree.map(lambda leaf: leaf.swapaxes(0, 1).reshape(-1, *leaf.shape[2:]), points)
    ends = jnp.tile(edge_index, POINTS)
    extended = jnp.any(outlines != outlines[:, :1, :1], axis=(1, 2, 3))
    radius = 0.5 * length * jnp.sum(extended[ends], axis=0)
    at_ends = jnp.stack([points.on_first, points.on_second])
    return Meeting(
        displacement=(points.gap + radius)[:, None] * points.normal,
        jacobian=levers(at_ends, position, turns, ends, turn_length),
        sliding=[points.on_face[:, None] * across(points.normal)],
        edge_index=ends,
    )


def levers(
    points: Float[Array, "*C 2"],
    position: Float[Array, "N 3"],
    turns: Float[Array, " N"],
    node: Int[Array, "*C"],
    turn_length: float,
) -> Float[Array, "*C 2 3"]:
    """Maps the velocity of the bodies ``node`` to that of their ``points`` [m]."""
    turning = across(points - position[node, :2]) * (turns[node] / turn_length)[..., None]
    whole = jnp.broadcast_to(jnp.eye(2, dtype=points.dtype), (*node.shape, 2, 2))
    return jnp.concatenate([whole, turning[..., None]], axis=-1)


def turned(vector: Float[Array, "... 2"], angle: Float[Array, "..."]) -> Float[Array, "... 2"]:
    """The vectors, turned by ``angle`` [rad]."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def across(vector: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """The vectors, turned by a quarter: the velocity at that place of a body that turns by 1 /s."""
    return jnp.stack([-vector[..., 1], vector[..., 0]], axis=-1)


def placed(
    outlines: Float[Array, "N P V 2"], position: Float[Array, "N 2"], angle: Float[Array, " N"]
) -> Float[Array, "N P V 2"]:
    """The outlines [m] of bodies at these positions [m] and angles [rad]."""
    return position[:, None, None] + turned(outlines, angle[:, None, None])


def contact_points(
    outlines: Float[Array, "N P V 2"], edge_index: Int[Array, "2 E"], length: float
) -> ContactPoints:
    """The `POINTS` points of contact of every edge, [E, POINTS], of `placed` outlines.

    Points nearer to each other than a twentieth of ``length`` [m] count once.
    """
    # Both ways: vertices of one body and the polygons of the other.
    ways = jnp.stack([edge_index, edge_index[::-1]], axis=1)
    vertices, sides = outlines[ways[0]], outlines[ways[1]]
    vertices = vertices.reshape(*vertices.shape[:2], -1, 2)
    found = jax.lax.stop_gradient(_candidates(vertices, sides))
    every = jax.tree.map(lambda leaf: jnp.concatenate(list(leaf), axis=1), found)
    rows = jnp.arange(edge_index.shape[1])[:, None]
    chosen, exists = _nearest(every.gap, every.middle, every.normal, length)
    way, index = jnp.divmod(chosen, every.gap.shape[1] // 2)
    vertex, polygon = jnp.divmod(index, sides.shape[2])
    side = jnp.take_along_axis(every.side, chosen, axis=1)
    begin = sides[way, rows, polygon, side]
    end = sides[way, rows, polygon, (side + 1) % sides.shape[3]]
    on_face = jnp.take_along_axis(every.on_face, chosen, axis=1)
    gap, normal, on_one, on_other = _between(vertices[way, rows, vertex], begin, end, on_face)
    back = (way == 1)[..., None]
    return ContactPoints(
        gap=jnp.where(exists, gap, _FAR * length),
        normal=jnp.where(back, -normal, normal),
        on_first=jnp.where(back, on_other, on_one),
        on_second=jnp.where(back, on_one, on_other),
        on_face=on_face,
    )


def as_near(points: Geometry, nearest: Geometry, tolerance: float) -> Float[Array, " C"]:
    """1 for points of contact that come as near as the nearest of their edge, or touch, else down
    to 0 within about a ``tolerance`` [m]; rows as of `EncodedGraph.contact_points`."""
    touch = jnp.maximum(nearest.closest_approach, nearest.contact_distance)
    count = len(points.distance) // max(1, len(touch))
    excess = jax.nn.relu(points.closest_approach - jnp.tile(touch, count))
    return jnp.exp(-((excess / tolerance) ** 2))


def plane_points(
    outlines: Float[Array, "N P V 2"], planes: Float[Array, "P 3"], length: float
) -> tuple[Float[Array, "N P points"], Float[Array, "N P points 2"]]:
    """The `POINTS` lowest vertices of every body above every plane: their heights and places, m.

    ``planes``: see `Nodes.planes`.
    """
    vertices = jnp.repeat(outlines.reshape(len(outlines), 1, -1, 2), len(planes), axis=1)
    normal, offset = planes[:, None, :-1], planes[:, -1:]
    height = jnp.sum(vertices * normal, axis=-1) - offset
    flat = jax.lax.stop_gradient(height).reshape(-1, height.shape[2])
    places = vertices.reshape(*flat.shape, 2)
    chosen, exists = (
        leaf.reshape(*height.shape[:2], POINTS)
        for leaf in _nearest(flat, places, jnp.ones_like(places), length)
    )
    lowest = jnp.take_along_axis(vertices, chosen[..., None], axis=2)
    height = jnp.take_along_axis(height, chosen, axis=2)
    return jnp.where(exists, height, _FAR * length), lowest


def _nearest(
    gap: Float[Array, "E M"],
    place: Float[Array, "E M 2"],
    normal: Float[Array, "E M 2"],
    length: float,
) -> tuple[Int[Array, "E points"], Bool[Array, "E points"]]:
    """The `POINTS` candidates with the least gap that differ by place or normal, if there are."""
    left, chosen, exists = gap, [], []
    for _ in range(POINTS):
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
    """Vertices of one body against the polygons of the other, flattened."""

    gap: Float[Array, "ways E MP"]
    """Infinite where a vertex does not count."""
    side: Int[Array, "ways E MP"]
    on_face: Bool[Array, "ways E MP"]
    normal: Float[Array, "ways E MP 2"]
    """From the first body of the edge to the second."""
    middle: Float[Array, "ways E MP 2"]
    """m; between the two points."""


def _candidates(
    vertices: Float[Array, "ways E M 2"], polygons: Float[Array, "ways E P V 2"]
) -> _Candidates:
    """Candidates both ways; a vertex of a body with an outline does not count against a point."""
    point, begin = vertices[:, :, :, None, None], polygons[:, :, None]
    end = jnp.roll(begin, -1, axis=-2)
    is_side = jnp.any(end != begin, axis=-1)
    away, outward = _from_side(point, begin, end)
    apart = jnp.sum(away**2, axis=-1)
    height = jnp.sum((point - begin) * outward, axis=-1)
    height = jnp.where(is_side, height, -jnp.inf)
    inside = jnp.all(height <= 0.0, axis=-1) & jnp.any(is_side, axis=-1)
    index = jnp.where(inside, jnp.argmax(height, axis=-1), jnp.argmin(apart, axis=-1))
    chosen = index[..., None] == jnp.arange(is_side.shape[-1])
    # Above a face the nearest point is inside of it, and the way there is its normal.
    touches = apart < _ROUNDING**2 * jnp.sum((end - begin) ** 2, axis=-1)
    above = inside[..., None] | touches | (height > (1.0 - _ON_FACE) * jnp.sqrt(apart))
    on_face = jnp.any(chosen & is_side & above, axis=-1)
    corners = (jnp.where(chosen[..., None], each, 0.0) for each in (begin, end))
    first, last = (jnp.sum(each, axis=-2) for each in corners)
    gap, normal, on_one, on_other = _between(vertices[:, :, :, None], first, last, on_face)
    extended = jnp.any(vertices != vertices[:, :, :1], axis=(2, 3))
    counts = jnp.arange(vertices.shape[2]) == 0
    counts = jnp.where(extended[..., None], extended[::-1, :, None], counts)
    forth = jnp.array([1.0, -1.0]).reshape(2, *(1,) * (normal.ndim - 1))
    result = (
        jnp.where(counts[..., None], gap, jnp.inf),
        index,
        on_face,
        forth * normal,
        0.5 * (on_one + on_other),
    )
    return _Candidates(*(leaf.reshape(*leaf.shape[:2], -1, *leaf.shape[4:]) for leaf in result))


def _between(
    point: Float[Array, "*C 2"],
    begin: Float[Array, "*C 2"],
    end: Float[Array, "*C 2"],
    on_face: Bool[Array, "*C"],
) -> tuple[Float[Array, "*C"], Float[Array, "*C 2"], Float[Array, "*C 2"], Float[Array, "*C 2"]]:
    """Gap, normal, and the points of both, of a point and a side of a counter-clockwise polygon.

    ``on_face``: the gap is the height above the line of the side, below 0 behind it.
    """
    away, outward = _from_side(point, begin, end)
    apart = jnp.sqrt(jnp.sum(away**2, axis=-1) + _SMALL)
    gap = jnp.where(on_face, jnp.sum((point - begin) * outward, axis=-1), apart)
    normal = -jnp.where(on_face[..., None], outward, away / apart[..., None])
    whole = jnp.broadcast_to(point, normal.shape)
    return gap, normal, whole, whole + gap[..., None] * normal


def _from_side(
    point: Float[Array, "*C 2"], begin: Float[Array, "*C 2"], end: Float[Array, "*C 2"]
) -> tuple[Float[Array, "*C 2"], Float[Array, "*C 2"]]:
    """The way to a point from the nearest one of a side, m, and the side's outward normal; that is
    0 for a side without length."""
    side, offset = end - begin, point - begin
    square = jnp.sum(side**2, axis=-1)
    inverse = jnp.where(square > 0.0, 1.0 / jnp.where(square > 0.0, square, 1.0), 0.0)
    fraction = jnp.clip(jnp.sum(offset * side, axis=-1) * inverse, 0.0, 1.0)
    return offset - fraction[..., None] * side, -across(side) * jnp.sqrt(inverse)[..., None]
