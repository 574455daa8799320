"""Geometry of the two nodes of every edge, and what it tells of contact: a prior, and a cutoff."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.model.shapes import Meeting, meeting

_MIN_SQUARE = 1e-12
_RESTING_SPEED = 0.01
"""Relative speed, in units of speed, well below which nothing counts as an approach."""

_REFINEMENTS = 3
"""Iterations for the time of impact under a force."""
_CHORDS = 8
"""Chords that approximate a path under a force: 10 N bend the path of 1 kg in 0.05 s by less than
0.1 mm away from them."""


class Geometry(eqx.Module):
    """Relative position and motion of the two nodes of every edge, relative to the first."""

    edge_index: Int[Array, "2 E"]
    """First and second node of each edge."""
    displacement: Float[Array, "E D"]
    """From the first to the second node, m; between the closest points where one is hinged, and
    see `box_displacement` where one is a box."""
    relative_velocity: Float[Array, "E D"]
    """Of the second node against the first, m/s, at the point of contact."""
    distance: Float[Array, " E"]
    """m"""
    closest_approach: Float[Array, " E"]
    """m; the least distance within the step without contact forces."""
    direction: Float[Array, "E D"]
    """Unit vector along the displacement."""
    normal: Float[Array, "E D"]
    """Unit vector from the first to the second node in the middle of their contact in the step:
    from their impact, or now where there is none, to the end of the step."""
    impact_normal: Float[Array, "E D"]
    """The same at the beginning of that contact."""
    approach: Float[Array, " E"]
    """m; along the normal in the step, without contact forces; negative where nodes part."""
    time_of_impact: Float[Array, " E"]
    """As a share of the step; 0 where the two nodes do not meet, or touch from the beginning."""
    fraction_after_impact: Float[Array, " E"]
    """One minus the time of impact, as a share of the step in [0, 1]; the impact is where the two
    nodes, if nothing hindered them, would be a contact distance apart. 0 where they do not meet."""
    contact_jacobian: Float[Array, "2 E d c"]
    """Maps the velocities of both nodes to their velocities at the point of contact; D by D where
    there are hinges, D by G where bodies turn, else ones, 1 by 1. 0 for a node that never moves."""
    contact_distance: Float[Array, " E"]
    """m, of the two nodes when they touch, centre to centre or to a bar's middle line."""

    def incidence(self, count: int) -> Float[Array, "2 E N"]:
        """1 where an edge has one of `count` nodes as its first or second node, else 0."""
        node = jnp.arange(count)
        return (self.edge_index[..., None] == node).astype(self.contact_jacobian.dtype)

    def first(self, count: int) -> "Geometry":
        """That of the first ``count`` rows."""
        by_end = ("edge_index", "contact_jacobian")  # the two ends are the first axis
        return type(self)(
            **{
                name: leaf[:, :count] if name in by_end else leaf[:count]
                for name, leaf in vars(self).items()
            }
        )

    def along(self, across: Float[Array, " E"]) -> "Geometry":
        """The same, with only that share of each edge's velocities across its normal.

        An edge with share 0 couples its nodes along the normal alone. Its d is D.
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
        return dataclasses.replace(self, contact_jacobian=jacobian, relative_velocity=relative)


def geometry(
    position: Float[Array, "N G"],
    velocity: Float[Array, "N G"],
    edge_index: Int[Array, "2 E"],
    dt: float,
    contact_distance: Float[Array, "*E"] | float,
    control_displacement: Float[Array, "N G"] | None = None,
    anchor: Float[Array, "N D"] | None = None,
    static: Bool[Array, " N"] | None = None,
    speed: float = 1.0,
    half_size: Float[Array, "N D"] | None = None,
    shapes: Meeting | None = None,
    coasting: Float[Array, "N G"] | None = None,
) -> Geometry:
    """The geometry of the edges at one step of `dt` [s]; finite where nodes coincide.

    Bodies touch `contact_distance` [m] apart, centre to centre: all of them, or each edge's.
    `control_displacement` [m] is how far the step's control alone moves the nodes, where known.
    `anchor` [m] is where nodes are hinged, NaN where they are not; `static` nodes never move.
    `speed` [m/s] is the unit of speeds. `half_size` [m] is that of nodes that are boxes. `shapes`
    tells where bodies meet that have shapes and turn; rows are then its own.
    """
    if shapes is None:
        shapes = meeting(position, edge_index, anchor, half_size)
    displacement, jacobian, sliding, edge_index = shapes
    if static is not None:
        jacobian = jnp.where(static[edge_index][..., None, None], 0.0, jacobian)

    def relative(motion: Float[Array, "N G"]) -> Float[Array, "E D"]:
        at_ends = motion[edge_index]
        if jacobian.shape[-1] > 1:
            at_ends = jnp.einsum("eijk,eik->eij", jacobian, at_ends)
        return at_ends[1] - at_ends[0]

    def approach(motion: Float[Array, "E D"]) -> Float[Array, "E D"]:
        # A point that slides along a bar does not come nearer.
        for along in sliding:
            motion = motion - along * jnp.sum(along * motion, axis=-1, keepdims=True)
        return motion

    relative_velocity = relative(velocity)
    drifted = dt * approach(relative_velocity if coasting is None else relative(coasting))
    driven, chords, refinements = jnp.zeros_like(drifted), 1, 1
    if control_displacement is not None:
        driven, chords = approach(relative(control_displacement)), _CHORDS
        refinements = _REFINEMENTS
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
        edge_index=edge_index,
        displacement=displacement,
        relative_velocity=relative_velocity,
        distance=distance,
        closest_approach=closest_approach,
        direction=displacement / distance[:, None],
        normal=normal,
        impact_normal=impact_normal,
        approach=-jnp.sum(normal * (drifted + driven), axis=-1),
        time_of_impact=jnp.where(meets, time, 0.0),
        fraction_after_impact=(1.0 - time) * impact,
        contact_jacobian=jacobian,
        contact_distance=jnp.broadcast_to(jnp.asarray(contact_distance), distance.shape),
    )


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


class ClosestApproachPrior(eqx.Module):
    r"""Probability of contact from the closest approach of two nodes within the step.

    $$ q = \epsilon + (1 - 2 \epsilon)\, \sigma\big( 2 (m \rho - d) / (s \rho) \big) $$

    with $\rho$ the contact distance, which the model learns from impacts, and $d$ the distance of
    closest approach in the next step: the edge of a step must already be active when bodies touch
    *within* it. No gradient flows to $\rho$. The prior is never more certain than $\epsilon$,
    because an unknown force may bring bodies together or keep them apart.
    """

    margin: float = eqx.field(static=True, default=1.03)
    """$m$; factor on the contact distance below which nodes count as touching."""
    sharpness: float = eqx.field(static=True, default=0.02)
    """$s$."""
    min_probability: float = eqx.field(static=True, default=0.01)
    r"""$\epsilon$."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Prior probability that each edge is active."""
        touch = jax.lax.stop_gradient(geometry.contact_distance)
        margin = (self.margin * touch - geometry.closest_approach) / (self.sharpness * touch)
        spread = 1.0 - 2.0 * self.min_probability
        return self.min_probability + spread * jax.nn.sigmoid(2.0 * margin)


class SmoothCutoff(eqx.Module):
    """Weight of an edge by distance: 1 below `inner` [m], exactly 0 from `outer` [m] on.

    A node beyond the cutoff of all others changes no prediction of theirs, exactly.
    """

    inner: float = eqx.field(static=True, default=0.15)
    outer: float = eqx.field(static=True, default=0.25)

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight of each edge in [0, 1], by its closest approach in the step."""
        fraction = (self.outer - geometry.closest_approach) / (self.outer - self.inner)
        fraction = jnp.clip(fraction, 0.0, 1.0)
        return fraction**2 * (3.0 - 2.0 * fraction)


class NoCutoff(eqx.Module):
    """Weight 1 at every distance: the paper's all-pairs inference."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight 1 for every edge."""
        return jnp.ones_like(geometry.distance)
