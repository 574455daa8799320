"""Convex bodies: vertices against facets, edges that cross, and vertices that slide on a ground."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from contactgraph.bodies.rotations import across, rotation_matrix

_SMALL = 1e-12
_PARALLEL = 1e-3
"""Squared sine of the angle of two edges, below which they do not cross."""
_BOTH = 0.02
"""Part of the speed of a turn that is added to the speed of the body, and the reverse: where one of
them is 0, the limits for small ones tell the friction."""


def vertices_of(outlines: Float[Array, "... D"]) -> Float[Array, "... D"]:
    """[..., V, D]: see `Nodes.outlines`."""
    return outlines if outlines.shape[-1] == 2 else outlines[..., 3, :]


def facets_of(outlines: Float[Array, "... D"]) -> Float[Array, "... D"]:
    """[..., V, D, D]: the ends of each side of polygons, the corners of each triangle of hulls."""
    if outlines.shape[-1] == 3:
        return outlines[..., :3, :]
    return jnp.stack([outlines, jnp.roll(outlines, -1, axis=-2)], axis=-2)


def from_facet(
    point: Float[Array, "*C D"], corners: Float[Array, "*C D D"]
) -> tuple[Float[Array, "*C D"], Float[Array, "*C D"]]:
    """The way to a point from the nearest one of a facet, m, and the facet's outward normal; that
    is 0 for one without extent. Polygons and triangles run counter-clockwise, seen from outside."""
    if corners.shape[-1] == 2:
        begin, end = corners[..., 0, :], corners[..., 1, :]
        return _from_segment(point, begin, end), -_unit(across(end - begin))
    following = jnp.roll(corners, -1, axis=-2)
    side = following - corners
    outward = _unit(jnp.cross(side[..., 0, :], side[..., 1, :]))
    offset = point[..., None, :] - corners
    height = jnp.sum(offset[..., 0, :] * outward, axis=-1)
    inward = jnp.cross(outward[..., None, :], side)
    above = jnp.all(jnp.sum(inward * offset, axis=-1) >= 0.0, axis=-1)
    above = above & jnp.any(outward != 0.0, axis=-1)
    away = _from_segment(point[..., None, :], corners, following)
    apart = jnp.sum(away**2, axis=-1)
    nearest = jnp.argmin(apart, axis=-1)[..., None] == jnp.arange(3)
    away = jnp.sum(jnp.where(nearest[..., None], away, 0.0), axis=-2)
    return jnp.where(above[..., None], height[..., None] * outward, away), outward


def _from_segment(
    point: Float[Array, "*C D"], begin: Float[Array, "*C D"], end: Float[Array, "*C D"]
) -> Float[Array, "*C D"]:
    """The way to a point from the nearest one of a segment."""
    side, offset = end - begin, point - begin
    inverse = _inverse(jnp.sum(side**2, axis=-1))
    fraction = jnp.clip(jnp.sum(offset * side, axis=-1) * inverse, 0.0, 1.0)
    return offset - fraction[..., None] * side


def _inverse(square: Float[Array, "*C"]) -> Float[Array, "*C"]:
    return jnp.where(square > 0.0, 1.0 / jnp.where(square > 0.0, square, 1.0), 0.0)


def _unit(vector: Float[Array, "*C D"]) -> Float[Array, "*C D"]:
    """0 where the vector is."""
    square = jnp.sum(vector**2, axis=-1, keepdims=True)
    length = jnp.where(square > 0.0, jnp.sqrt(1.0 / jnp.where(square > 0.0, square, 1.0)), 0.0)
    return vector * length


def between(
    point: Float[Array, "*C D"], corners: Float[Array, "*C D D"], on_face: Bool[Array, "*C"]
) -> tuple[Float[Array, "*C"], Float[Array, "*C D"], Float[Array, "*C D"], Float[Array, "*C D"]]:
    """Gap, normal, and the points of both, of a point and a facet.

    ``on_face``: the gap is the height above the line or plane of the facet, below 0 behind it.
    """
    away, outward = from_facet(point, corners)
    apart = jnp.sqrt(jnp.sum(away**2, axis=-1) + _SMALL)
    height = jnp.sum((point - corners[..., 0, :]) * outward, axis=-1)
    gap = jnp.where(on_face, height, apart)
    normal = -jnp.where(on_face[..., None], outward, away / apart[..., None])
    whole = jnp.broadcast_to(point, normal.shape)
    return gap, normal, whole, whole + gap[..., None] * normal


def across_edges(
    first: Float[Array, "*C 2 3"], second: Float[Array, "*C 2 3"], outward: Float[Array, "*C 3"]
) -> tuple[Float[Array, "*C"], Float[Array, "*C 3"], Float[Array, "*C 3"], Float[Array, "*C 3"]]:
    """Gap, normal along ``outward``, and the nearest points of the lines of two edges."""
    one, other = (each[..., 1, :] - each[..., 0, :] for each in (first, second))
    offset, area = second[..., 0, :] - first[..., 0, :], jnp.cross(one, other)
    square = jnp.sum(area**2, axis=-1, keepdims=True)
    inverse = _inverse(square)
    ahead = jnp.sum(area * outward, axis=-1, keepdims=True) >= 0.0
    normal = _unit(jnp.where(ahead, area, -area))
    parts = (
        jnp.sum(jnp.cross(offset, along) * area, axis=-1, keepdims=True) * inverse
        for along in (other, one)
    )
    on_first, on_second = (
        each[..., 0, :] + part * along
        for each, part, along in zip((first, second), parts, (one, other), strict=True)
    )
    return jnp.sum(offset * normal, axis=-1), normal, on_first, on_second


def facet_distances(
    point: Float[Array, "*C M D"], corners: Float[Array, "*C P V D D"]
) -> tuple[Float[Array, "*C M P V"], Float[Array, "*C M P V"]]:
    """Squared distances of points from facets, and heights above their lines or planes, m; those
    are infinite below facets without extent. See `from_facet`."""
    if point.shape[-1] == 2:
        point, corners = point[..., None, None, :], corners[..., None, :, :, :, :]
        away, outward = from_facet(point, corners)
        height = jnp.sum((point - corners[..., 0, :]) * outward, axis=-1)
        is_facet = jnp.any(outward != 0.0, axis=-1)
        return jnp.sum(away**2, axis=-1), jnp.where(is_facet, height, -jnp.inf)
    # Sums over a last axis of three numbers would take ten times as long.
    points = _parts(point[..., None, None, :])
    corners = corners[..., None, :, :, :, :]
    ends = [_parts(corners[..., each, :]) for each in range(3)]
    sides = [_minus(ends[(each + 1) % 3], ends[each]) for each in range(3)]
    area = _cross(sides[0], sides[1])
    square = _dot(area, area)
    scale = jnp.where(square > 0.0, jnp.sqrt(_inverse(square)), 0.0)
    unit = tuple(scale * each for each in area)
    above, apart = square > 0.0, jnp.full_like(square, jnp.inf)
    for end, side in zip(ends, sides, strict=True):
        offset = _minus(points, end)
        above = above & (_dot(_cross(unit, side), offset) >= 0.0)
        part = jnp.clip(_dot(offset, side) * _inverse(_dot(side, side)), 0.0, 1.0)
        way = tuple(one - part * other for one, other in zip(offset, side, strict=True))
        apart = jnp.minimum(apart, _dot(way, way))
    height = _dot(_minus(points, ends[0]), unit)
    return jnp.where(above, height**2, apart), jnp.where(square > 0.0, height, -jnp.inf)


def crossings(
    hulls: Float[Array, "2 E P V 5 3"], overlap: Float[Array, " E"], tolerance: float
) -> tuple[Float[Array, "E M"], Float[Array, "E M 3"], Float[Array, "E M 3"]]:
    """Gap, infinite where they do not meet, normal and middle of all pairs of edges of two bodies.

    Edges meet where both bodies lie behind them, but for a ``tolerance`` [m]. They do not where the
    bodies would have to part by more than along the normal of a face, by ``overlap`` [m] below 0.
    """
    rows, flat = hulls.shape[3], (hulls.shape[1], -1)
    edges = hulls[..., 3:, :].reshape(2, hulls.shape[1], -1, 2, 3)
    # The corners of each edge's own hull, [V, E, M].
    own = jnp.moveaxis(jnp.repeat(hulls[..., 3, :], rows, axis=2), 3, 1)
    begins, along = edges[:, :, :, 0], edges[:, :, :, 1] - edges[:, :, :, 0]
    outward = _parts((jnp.mean(edges[0], axis=2) - jnp.mean(own[0], axis=0))[:, :, None])
    (begin, one), (start, other) = (
        [_parts(jnp.expand_dims(each[end], 2 - end)) for each in (begins, along)]
        for end in range(2)
    )
    area, offset = _cross(one, other), _minus(start, begin)
    square = _dot(area, area)
    scale = jnp.where(_dot(area, outward) < 0.0, -1.0, 1.0) * jnp.sqrt(_inverse(square))
    normal, gap = tuple(scale * each for each in area), scale * _dot(area, offset)
    part, share = (_dot(_cross(offset, each), area) * _inverse(square) for each in (other, one))
    meets = square > _PARALLEL * _dot(one, one) * _dot(other, other)
    meets &= (part > 0.0) & (part < 1.0) & (share > 0.0) & (share < 1.0)
    meets &= gap > overlap[:, None, None] - tolerance
    for end, sign, at in ((0, 1.0, begin), (1, -1.0, start)):
        corners = _parts(jnp.expand_dims(own[end], 3 - end))
        reach = _dot(tuple(each[None] for each in normal), corners)
        meets &= jnp.max(sign * reach, axis=0) - sign * _dot(normal, at) < tolerance
    middle = tuple(
        0.5 * (a + part * b + c + share * d)
        for a, b, c, d in zip(begin, one, start, other, strict=True)
    )
    return (
        jnp.where(meets, gap, jnp.inf).reshape(flat),
        jnp.stack([each.reshape(flat) for each in normal], axis=-1),
        jnp.stack([each.reshape(flat) for each in middle], axis=-1),
    )


_Parts = tuple[Array, ...]
"""The components of vectors."""


def _parts(vector: Float[Array, "*C D"]) -> _Parts:
    return tuple(vector[..., each] for each in range(vector.shape[-1]))


def _minus(one: _Parts, other: _Parts) -> _Parts:
    return tuple(a - b for a, b in zip(one, other, strict=True))


def _dot(one: _Parts, other: _Parts) -> Array:
    return sum((a * b for a, b in zip(one[1:], other[1:], strict=True)), one[0] * other[0])


def _cross(one: _Parts, other: _Parts) -> _Parts:
    (x, y, z), (u, v, w) = one, other
    return y * w - z * v, z * u - x * w, x * v - y * u


class Patch(eqx.Module):
    """The vertices of hulls, each with an equal part of the weight and Coulomb's friction.

    The power of friction is that of a norm of the velocity, the mean speed of the vertices, whose
    gradient is the force and the torque (Goyal, Ruina and Papadopoulos 1991).
    """

    lever: Float[Array, "N V D"]
    """Level velocity of each vertex for a unit of turning about the direction against gravity."""
    weight: Float[Array, "N V 1"]
    """Part of the body's weight on each row, of which several may tell one vertex."""
    axis: Float[Array, "N 3"]
    """That direction in the axes of the body."""
    upward: Float[Array, " D"]

    @classmethod
    def of(
        cls,
        outlines: Float[Array, "N P V 5 3"] | None,
        gravity: Float[Array, " D"] | None,
        position: Float[Array, "N G"],
        turn_length: float | None,
    ) -> "Patch | None":
        """At these positions. None: bodies do not turn in space, or have no weight."""
        if outlines is None or gravity is None or turn_length is None or position.shape[1] != 6:
            return None
        position = jax.lax.stop_gradient(position)
        turn = rotation_matrix(position[:, 3:] / turn_length)
        upward = -gravity / jnp.sqrt(jnp.sum(gravity**2))
        corners = vertices_of(outlines).reshape(len(position), -1, 3)
        arm = jnp.einsum("nij,nvj->nvi", turn, corners) / turn_length
        alike = jnp.all(corners[:, :, None] == corners[:, None], axis=-1)
        share = 1.0 / jnp.sum(alike, axis=2, keepdims=True)
        share = share / jnp.sum(share, axis=1, keepdims=True)
        axis = jnp.einsum("nij,i->nj", turn, upward)
        return cls(jnp.cross(upward, arm), share.astype(arm.dtype), axis, upward)

    def sliding(
        self, velocity: Float[Array, "N G"], slow: float
    ) -> tuple[Float[Array, "N 1"], Float[Array, "N G"]]:
        """The mean speed of the vertices, m/s, and what makes up its square: the part for the
        square of the velocity along each coordinate, which is the force over that velocity, times
        the speed. ``slow`` [m/s] is a speed at which bodies rest."""
        level = velocity[:, :3] - (velocity[:, :3] @ self.upward)[:, None] * self.upward
        spin = jnp.sum(velocity[:, 3:] * self.axis, axis=1, keepdims=True)
        reach = jnp.sum(self.weight * _length_of(self.lever), axis=1)
        across = jnp.cross(self.upward, jnp.eye(3)[jnp.argmin(jnp.abs(self.upward))])
        level_speed = _length_of(level)
        level += _BOTH * (jnp.abs(spin) * reach + slow) * across
        spin += jnp.where(spin < 0.0, -_BOTH, _BOTH) * (level_speed + slow) / (reach + 1e-9)
        moving = level[:, None] + spin[..., None] * self.lever
        speed = _length_of(moving)
        force = self.weight * moving / speed
        forward = jnp.sum(jnp.sum(force, axis=1) * level, axis=1, keepdims=True)
        turning = jnp.sum(force * self.lever, axis=(1, 2))[:, None]
        along = jnp.tile(forward / jnp.sum(level**2, axis=1, keepdims=True), 3)
        parts = jnp.concatenate([along, turning / spin * self.axis**2], axis=1)
        whole = jnp.sum(self.weight * speed, axis=1)
        return whole, whole * jnp.maximum(parts, 0.0)


def _length_of(vector: Float[Array, "*C D"]) -> Float[Array, "*C 1"]:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1, keepdims=True) + 1e-18)
