"""Geometry of the two nodes of every edge in one step: where, when and how they meet."""

import dataclasses
import math
from typing import Self, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_MIN_SQUARE = 1e-12
_PRODUCT_NODES = 32
"""Up to this number of nodes a one-hot product is faster on CPU than a scatter."""
_RESTING_SPEED = 0.01
"""Relative speed, in units of speed, well below which nothing counts as an approach."""

_LEAST_APPROACH = 1e-9
"""m; by which is divided."""
_REFINEMENTS = 3
"""Iterations for the time of impact under a force."""
_CHORDS = 8
"""Chords that approximate a path under a force: 10 N bend the path of 1 kg in 0.05 s by less than
0.1 mm away from them."""


Module = TypeVar("Module", bound=eqx.Module)


class Rows(eqx.Module):
    """Pairs of bodies, and what moves where they meet, a row each: the linear map J."""

    edge_index: Int[Array, "2 C"]
    """First and second body."""
    contact_jacobian: Float[Array, "2 C d c"]
    """Maps the velocities of both bodies to their velocities at the point of contact; D by D where
    there are hinges, D by G where bodies turn, else ones, 1 by 1. 0 for one that never moves."""

    def relative(self, x: Float[Array, "N c ..."]) -> Float[Array, "C d ..."]:
        """J x: the difference of the second and the first bodies, at the points of contact."""
        at_ends = x[self.edge_index]
        if self.contact_jacobian.shape[-1] > 1:
            at_ends = jnp.einsum("sedg,seg...->sed...", self.contact_jacobian, at_ends)
        return at_ends[1] - at_ends[0]

    def to_nodes(self, on_rows: Float[Array, "C d k"], count: int) -> Float[Array, "N c k"]:
        """The transpose of J, for ``count`` nodes."""
        arriving = jnp.stack([-on_rows, on_rows])
        if self.contact_jacobian.shape[-1] > 1:
            arriving = jnp.einsum("seji,sejc->seic", self.contact_jacobian, arriving)
        return sum_at_nodes(arriving, self.edge_index, count)

    def dense(self, count: int) -> Float[Array, "Cd Nc"]:
        """J as one matrix, for ``count`` nodes."""
        jacobian = self.contact_jacobian
        first, second = incidence(self.edge_index, count).astype(jacobian.dtype)
        blocks = second[:, None, :, None] * jacobian[1][:, :, None, :]
        blocks = blocks - first[:, None, :, None] * jacobian[0][:, :, None, :]
        return blocks.reshape(jacobian.shape[1] * jacobian.shape[2], count * jacobian.shape[3])

    def first(self, count: int) -> Self:
        """The first ``count`` rows."""
        return jax.tree_util.tree_map_with_path(
            lambda path, leaf: leaf[:, :count] if _row_axis(path) else leaf[:count], self
        )


def joined(one: Module, other: Module) -> Module:
    """`Rows`, or what contains them, then the others."""
    return jax.tree_util.tree_map_with_path(
        lambda path, *leaves: jnp.concatenate(leaves, axis=_row_axis(path)), one, other
    )


def _row_axis(path: tuple) -> int:
    """The axis of rows in a leaf of `Rows`: the first, but where the two ends are."""
    return int(getattr(path[-1], "name", None) in ("edge_index", "contact_jacobian"))


class Meeting(Rows):
    """Places at which bodies meet, as their positions tell them."""

    displacement: Float[Array, "C D"]
    """m; from the first to the second body, between the closest points where one is hinged, and
    see `box_displacement` where one is a box."""
    sliding: list[Float[Array, "C D"]]
    """Directions, unit vectors or 0, in which they slide without coming nearer."""

    def with_fixed(self, static: Bool[Array, " N"] | None) -> Self:
        """The same, of which nothing that happens moves the ``static`` nodes."""
        if static is None:
            return self
        fixed = static[self.edge_index][..., None, None]
        jacobian = jnp.where(fixed, 0.0, self.contact_jacobian)
        return dataclasses.replace(self, contact_jacobian=jacobian)


class Geometry(Meeting):
    """Position and motion in one step of the second body against the first, where they meet."""

    relative_velocity: Float[Array, "C D"]
    """m/s, at the point of contact."""
    distance: Float[Array, " C"]
    """m"""
    direction: Float[Array, "C D"]
    """Unit vector along the displacement; the normal of a plane."""
    closest_approach: Float[Array, " C"]
    """m; the least distance within the step without contact forces."""
    normal: Float[Array, "C D"]
    """Unit vector from the first to the second body in the middle of their contact in the step:
    from their impact, or now where there is none, to the end of the step."""
    impact_normal: Float[Array, "C D"]
    """The same at the beginning of that contact."""
    approach: Float[Array, " C"]
    """m; along the normal in the step, without contact forces; negative where bodies part."""
    time_of_impact: Float[Array, " C"]
    """As a share of the step; 0 where the two do not meet, or touch from the beginning."""
    fraction_after_impact: Float[Array, " C"]
    """One minus the time of impact, as a share of the step in [0, 1]; the impact is where the two,
    if nothing hindered them, would be a contact distance apart. 0 where they do not meet."""
    contact_distance: Float[Array, " C"]
    """m, of the two when they touch, centre to centre or to a bar's middle line."""

    @property
    def meeting(self) -> Meeting:
        """The part that positions alone tell."""
        return Meeting(self.edge_index, self.contact_jacobian, self.displacement, self.sliding)

    def along(self, across: Float[Array, " E"]) -> "Geometry":
        """The same, with only that share of each row's velocities across its normal.

        A row with share 0 couples its bodies along the normal alone. Its d is D.
        """
        normal = self.normal
        along = normal[:, :, None] * normal[:, None, :]
        whole = jnp.eye(normal.shape[-1], dtype=normal.dtype)
        kept = along + across[:, None, None] * (whole - along)
        relative = jnp.einsum("eij,ej->ei", kept, self.relative_velocity)
        if self.contact_jacobian.shape[-1] > 1:
            jacobian = jnp.einsum("eij,sejk->seik", kept, self.contact_jacobian)
        else:
            jacobian = kept * self.contact_jacobian
        return dataclasses.replace(
            self, contact_jacobian=jacobian, relative_velocity=relative, sliding=[]
        )


def geometry(
    meeting: Meeting,
    *,
    velocity: Float[Array, "N G"],
    dt: float,
    contact_distance: Float[Array, "*C"] | float,
    coasting: Float[Array, "N G"],
    driven: Float[Array, "C D"] | None = None,
    speed: float = 1.0,
) -> Geometry:
    """The geometry of a meeting at one step of ``dt`` [s]; finite where nodes coincide.

    Bodies touch ``contact_distance`` [m] apart, centre to centre: all of them, or each row's. Nodes
    move at ``velocity`` [m/s], and without contacts at ``coasting`` [m/s].
    ``driven`` [m] is how far the step's control alone moves the second body of each row against the
    first, where known. ``speed`` [m/s] is the unit of speeds.
    """
    displacement = meeting.displacement

    def approach(motion: Float[Array, "C D"]) -> Float[Array, "C D"]:
        # A point that slides along a bar does not come nearer.
        for along in meeting.sliding:
            motion = motion - along * jnp.sum(along * motion, axis=-1, keepdims=True)
        return motion

    drifted = dt * approach(meeting.relative(coasting))
    chords, refinements = (1, 1) if driven is None else (_CHORDS, _REFINEMENTS)
    driven = jnp.zeros_like(drifted) if driven is None else approach(driven)
    time, closest_approach = _closest_approach(displacement, drifted, driven, chords)
    meets, path = jnp.zeros_like(time, bool), drifted
    for _ in range(refinements):
        # A constant force has done a square of its work after a part of the step: its mean effect
        # until then is that part.
        path = drifted + time[:, None] * driven
        time, meets = _time_of_impact(displacement, path, contact_distance)
    # Bodies in contact that a force presses together meet at once, though they do not drift so.
    pressed = jnp.sum(displacement * (drifted + driven), axis=-1) < 0.0
    pressed = pressed & (jnp.sum(displacement**2, axis=-1) < contact_distance**2)
    time, meets = jnp.where(pressed, 0.0, time), meets | pressed
    # Bodies that stay coupled have relative velocities of rounding size, and no impact.
    square = jnp.sum((drifted + driven) ** 2, axis=-1)
    impact = meets * square / (square + (_RESTING_SPEED * speed * dt) ** 2)
    distance = _norm(displacement)
    time_of_contact = jnp.where(meets, time, 0.0)[:, None]
    touching = displacement + time_of_contact * path
    impact_normal = touching / _norm(touching)[:, None]
    # Bodies that slide on each other turn the normal: that of the middle of the contact counts.
    across = path - impact_normal * jnp.sum(impact_normal * path, axis=-1, keepdims=True)
    touching = touching + 0.5 * (1.0 - time_of_contact) * across
    normal = touching / _norm(touching)[:, None]
    return Geometry(
        edge_index=meeting.edge_index,
        contact_jacobian=meeting.contact_jacobian,
        displacement=displacement,
        sliding=meeting.sliding,
        relative_velocity=meeting.relative(velocity),
        distance=distance,
        direction=displacement / distance[:, None],
        closest_approach=closest_approach,
        normal=normal,
        impact_normal=impact_normal,
        approach=-jnp.sum(normal * (drifted + driven), axis=-1),
        time_of_impact=jnp.where(meets, time, 0.0),
        fraction_after_impact=(1.0 - time) * impact,
        contact_distance=jnp.broadcast_to(jnp.asarray(contact_distance), time.shape),
    )


def as_near(points: Geometry, nearest: Geometry, tolerance: float) -> Float[Array, " C"]:
    """1 for points of contact that come as near as the nearest of their edge, or touch, else down
    to 0 within about a ``tolerance`` [m]; rows as of `EncodedGraph.contact_points`."""
    touch = jnp.maximum(nearest.closest_approach, nearest.contact_distance)
    count = len(points.distance) // max(1, len(touch))
    excess = jax.nn.relu(points.closest_approach - jnp.tile(touch, count))
    return jnp.exp(-((excess / tolerance) ** 2))


def along_normals(
    rows: Rows,
    *,
    normal: Float[Array, "C D"],
    distance: Float[Array, " C"],
    contact_distance: Float[Array, " C"],
    velocity: Float[Array, "N G"],
    motion: Float[Array, "N G"],
) -> Geometry:
    """The geometry of ``rows`` whose normals do not turn in a step, such as those of planes.

    Two bodies are ``distance`` [m] apart along the ``normal``, touch at the ``contact_distance``
    [m], and would move by ``motion`` [m] in the step without contacts.
    """
    approach = -jnp.sum(normal * rows.relative(motion), axis=-1)
    time = (distance - contact_distance) / jnp.maximum(approach, _LEAST_APPROACH)
    time = jnp.clip(time, 0.0, 1.0)
    meets = (approach > 0.0) & (time < 1.0)
    return Geometry(
        edge_index=rows.edge_index,
        contact_jacobian=rows.contact_jacobian,
        displacement=distance[:, None] * normal,
        sliding=[],
        relative_velocity=rows.relative(velocity),
        distance=distance,
        direction=normal,
        closest_approach=distance - jnp.maximum(approach, 0.0),
        normal=normal,
        impact_normal=normal,
        approach=approach,
        time_of_impact=jnp.where(meets, time, 0.0),
        fraction_after_impact=(1.0 - time) * meets,
        contact_distance=contact_distance,
    )


def incidence(edge_index: Int[Array, "2 E"], count: int) -> Bool[Array, "2 E N"]:
    """Whether an edge has one of ``count`` nodes as its first or second node."""
    return edge_index[..., None] == jnp.arange(count)


def _closest_approach(
    displacement: Float[Array, "E D"],
    drifted: Float[Array, "E D"],
    driven: Float[Array, "E D"],
    chords: int,
) -> tuple[Float[Array, " E"], Float[Array, " E"]]:
    """The time of closest approach, as a part of the step, and the distance then, m.

    The path under a force is a parabola, approximated by chords.
    """
    times = jnp.linspace(0.0, 1.0, chords + 1, dtype=displacement.dtype)[:, None, None]
    path = displacement + times * (drifted + times * driven)
    begin, chord_path = path[:-1], path[1:] - path[:-1]
    square = jnp.maximum(jnp.sum(chord_path**2, axis=-1), _MIN_SQUARE)
    along = jnp.clip(-jnp.sum(begin * chord_path, axis=-1) / square, 0.0, 1.0)
    apart = jnp.sum((begin + along[..., None] * chord_path) ** 2, axis=-1)
    chord = jnp.argmin(apart, axis=0)
    part = jnp.sum(jnp.where(jnp.arange(chords)[:, None] == chord, along, 0.0), axis=0)
    return (chord + part) / chords, jnp.sqrt(jnp.min(apart, axis=0) + _MIN_SQUARE)


def _time_of_impact(
    displacement: Float[Array, "E D"],
    path: Float[Array, "E D"],
    contact_distance: Float[Array, "*E"] | float,
) -> tuple[Float[Array, " E"], Bool[Array, " E"]]:
    """The time of impact, as a part of the step, and whether there is an impact.

    The earlier root of |r + w s| = contact distance, where two nodes approach each other; the time
    of closest approach where they stay farther apart.
    """
    square = jnp.maximum(jnp.sum(path**2, axis=-1), _MIN_SQUARE)
    closing = -jnp.sum(displacement * path, axis=-1)
    gap = jnp.sum(displacement**2, axis=-1) - contact_distance**2
    discriminant = closing**2 - square * gap
    meets = (discriminant > 0) & (closing > 0)
    root = jnp.sqrt(jnp.where(meets, discriminant, 1.0))
    time = jnp.clip(jnp.where(meets, closing - root, closing) / square, 0.0, 1.0)
    return time, meets & (time < 1.0)


def _norm(vector: Float[Array, "*C E D"]) -> Float[Array, "*C E"]:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + _MIN_SQUARE)


def travel_bound(
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    control_displacement: Float[Array, "N D"] | None,
    anchor: Float[Array, "N D"] | None,
    dt: float,
    half_size: Float[Array, "N D"] | None = None,
    outlines: Float[Array, "N P V ..."] | None = None,
) -> Float[Array, " N"]:
    """Largest distance [m] from a node's position at which its body may be met in a step of ``dt``
    [s]; arguments as of `geometry` and `meeting`, ``outlines`` see `Nodes`."""
    bound = dt * jnp.linalg.norm(velocity, axis=-1)
    if control_displacement is not None:
        bound = bound + jnp.linalg.norm(control_displacement, axis=-1)
    if half_size is not None:  # a corner is farther from the centre than the nearest side
        bound = bound + jnp.linalg.norm(half_size, axis=-1) - jnp.min(half_size, axis=-1)
    if outlines is not None:
        lengths = jnp.linalg.norm(outlines, axis=-1).reshape(len(outlines), -1)
        bound = bound + jnp.max(lengths, axis=1)
    if anchor is None:
        return bound
    # A bar's far end is a radius from its middle, and twice as fast.
    radius = jnp.linalg.norm(position - anchor, axis=-1)
    return jnp.where(jnp.isfinite(radius), radius + 2.0 * bound, bound)


def sum_at_nodes(
    arriving: Float[Array, "2 E ..."], edge_index: Int[Array, "2 E"], count: int
) -> Float[Array, "N ..."]:
    """Sum, at each of `count` nodes, over the edges that have it as first or second node."""
    flat = arriving.reshape(-1, *arriving.shape[2:])
    if count > _PRODUCT_NODES:
        return jax.ops.segment_sum(flat, edge_index.reshape(-1), count)
    arrives = (jnp.arange(count)[:, None] == edge_index.reshape(-1)).astype(arriving.dtype)
    columns = flat.reshape(flat.shape[0], math.prod(flat.shape[1:]))
    return (arrives @ columns).reshape(count, *flat.shape[1:])
