"""Distances and relative motion along the edges."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.model.hinge import HingedBodies

_SMALLEST = 1e-12
_RESTING_SPEED = 0.01
"""Relative speed, m/s, well below which nothing counts as an approach."""

_REFINEMENTS = 3
"""Of the moment of touch under a force."""
_CHORDS = 8
"""Of the way under a force: 10 N bend that of 1 kg in 0.05 s by less than 0.1 mm from them."""


class Geometry(eqx.Module):
    """How the two nodes of every edge lie and move relative to each other, seen from the first."""

    first: Int[Array, " E"]
    second: Int[Array, " E"]
    displacement: Float[Array, "E D"]
    """From the first to the second node, m; between the nearest points where one is hinged."""
    relative_velocity: Float[Array, "E D"]
    """Of the second node against the first, m/s, where they meet."""
    distance: Float[Array, " E"]
    """m"""
    predicted_distance: Float[Array, " E"]
    """m; after one step without forces."""
    closest_approach: Float[Array, " E"]
    """m; the least distance within the step without forces."""
    direction: Float[Array, "E D"]
    """Unit vector along the displacement."""

    fraction_after_impact: Float[Array, " E"]
    """Share of the coming step, in [0, 1], that follows the moment at which the two nodes, if
    nothing hindered them, would come as near as bodies touch. 0 where they do not meet."""

    contact_jacobian: Float[Array, "2 E d d"]
    """What takes the velocities of both nodes to where they meet, d = D, where there
    are hinges; ones, d = 1, where there are none."""

    def ends(self, count: int) -> tuple[Float[Array, "E N"], Float[Array, "E N"]]:
        """1 where an edge has one of `count` nodes as its first, and as its second end; else 0."""
        node, dtype = jnp.arange(count), self.contact_jacobian.dtype
        first = (self.first[:, None] == node).astype(dtype)
        return first, (self.second[:, None] == node).astype(dtype)


def geometry(
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    pairs: Int[Array, "E 2"],
    dt: float,
    contact_distance: Float[Array, "*E"] | float,
    control_displacement: Float[Array, "N D"] | None = None,
    anchor: Float[Array, "N D"] | None = None,
) -> Geometry:
    """The geometry of the edges `pairs` at one step of `dt` [s]; finite where nodes coincide.

    Bodies touch `contact_distance` [m] apart, centre to centre: all of them, or each edge's.
    `control_displacement` [m] is how far the step's control alone moves the nodes, where known.
    `anchor` [m] is where nodes are hinged, NaN where they are not.
    """
    first, second = pairs[:, 0], pairs[:, 1]
    displacement, lever, slides = _meeting(position, pairs, anchor)

    def relative(motion: Float[Array, "N D"]) -> Float[Array, "E D"]:
        if anchor is None:
            return motion[second] - motion[first]
        ends = jnp.stack([first, second])
        at_contact = jnp.einsum("eijk,eik->eij", lever, motion[ends])
        return at_contact[1] - at_contact[0]

    def nearing(motion: Float[Array, "E D"]) -> Float[Array, "E D"]:
        # A point that slides along a bar is no nearer for it.
        for along in slides:
            motion = motion - along * jnp.sum(along * motion, axis=-1, keepdims=True)
        return motion

    relative_velocity = relative(velocity)
    drifted = dt * nearing(relative_velocity)
    driven = (
        jnp.zeros_like(drifted)
        if control_displacement is None
        else nearing(relative(control_displacement))
    )
    closest, nearest = _closest(
        displacement, drifted, driven, 1 if control_displacement is None else _CHORDS
    )
    until, meets = closest, jnp.zeros_like(closest, bool)
    for _ in range(1 if control_displacement is None else _REFINEMENTS):
        until, meets = _touch(displacement, _way(drifted, driven, until), contact_distance)
    # Bodies that hold together have relative velocities of rounding size, and no impact.
    square = jnp.sum((drifted + driven) ** 2, axis=-1)
    impact = meets * square / (square + (_RESTING_SPEED * dt) ** 2)
    distance = _norm(displacement)
    return Geometry(
        first=first,
        second=second,
        displacement=displacement,
        relative_velocity=relative_velocity,
        distance=distance,
        predicted_distance=_norm(displacement + drifted + driven),
        closest_approach=nearest,
        direction=displacement / distance[:, None],
        fraction_after_impact=(1.0 - until) * impact,
        contact_jacobian=lever,
    )


def _meeting(
    position: Float[Array, "N D"], pairs: Int[Array, "E 2"], anchor: Float[Array, "N D"] | None
) -> tuple[Float[Array, "E D"], Float[Array, "2 E d d"], list[Float[Array, "E D"]]]:
    """Where pairs meet: displacement [m], levers, and the directions in which the points slide."""
    first, second = pairs[:, 0], pairs[:, 1]
    if anchor is None:
        one = jnp.ones((2, pairs.shape[0], 1, 1), position.dtype)
        return position[second] - position[first], one, []
    bars = HingedBodies(position, anchor)
    begin, begin_slides = bars.closest_point(first, position[second])
    end, end_slides = bars.closest_point(second, position[first])
    lever = jnp.stack(
        [
            bars.contact_jacobian(first, position[second]),
            bars.contact_jacobian(second, position[first]),
        ]
    )
    return end - begin, lever, [begin_slides, end_slides]


def _way(
    drifted: Float[Array, "E D"], driven: Float[Array, "E D"], part: Float[Array, " E"]
) -> Float[Array, "E D"]:
    """Mean way [m] a step until `part` of it is over: a constant force has then done that part
    squared of its work, not that part."""
    return drifted + part[:, None] * driven


def _closest(
    displacement: Float[Array, "E D"],
    drifted: Float[Array, "E D"],
    driven: Float[Array, "E D"],
    chords: int,
) -> tuple[Float[Array, " E"], Float[Array, " E"]]:
    """The part of the step after which two nodes are closest, and their distance then, m.

    The way under a force is a parabola, taken as so many chords.
    """
    ends = jnp.linspace(0.0, 1.0, chords + 1, dtype=displacement.dtype)[:, None, None]
    path = displacement + ends * (drifted + ends * driven)
    begin, way = path[:-1], path[1:] - path[:-1]
    square = jnp.maximum(jnp.sum(way**2, axis=-1), _SMALLEST)
    along = jnp.clip(-jnp.sum(begin * way, axis=-1) / square, 0.0, 1.0)
    apart = jnp.sum((begin + along[..., None] * way) ** 2, axis=-1)
    chord = jnp.argmin(apart, axis=0)
    part = jnp.take_along_axis(along, chord[None], axis=0)[0]
    return (chord + part) / chords, jnp.sqrt(jnp.min(apart, axis=0) + _SMALLEST)


def _touch(
    displacement: Float[Array, "E D"],
    way: Float[Array, "E D"],
    contact_distance: Float[Array, "*E"] | float,
) -> tuple[Float[Array, " E"], Bool[Array, " E"]]:
    """The part of the step until two nodes touch, and whether they do.

    The earlier root of |r + w s| = touch distance, where the two approach each other; where they
    do not come as near, the part until they are closest.
    """
    square = jnp.maximum(jnp.sum(way**2, axis=-1), _SMALLEST)
    closing = -jnp.sum(displacement * way, axis=-1)
    gap = jnp.sum(displacement**2, axis=-1) - contact_distance**2
    discriminant = closing**2 - square * gap
    meets = (discriminant > 0) & (closing > 0)
    root = jnp.sqrt(jnp.where(meets, discriminant, 1.0))
    until = jnp.clip(jnp.where(meets, closing - root, closing) / square, 0.0, 1.0)
    return until, meets & (until < 1.0)


def _norm(vector: Float[Array, "*C E D"]) -> Float[Array, "*C E"]:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + _SMALLEST)
