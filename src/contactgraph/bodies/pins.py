"""Pins: joints of two bodies that let them turn, as rows and as a projection after the step."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.geometry import (
    Geometry,
    Joined,
    along_normals,
    dense_jacobian,
    relative_at_edges,
)
from contactgraph.bodies.mass_matrix import dense_inverse, product
from contactgraph.bodies.rotations import levers, turned
from contactgraph.bodies.shapes import Meeting
from contactgraph.data.graph import edge_id
from contactgraph.data.trajectory_batch import Nodes

_CORRECTIONS = 2
"""Newton iterations: a gap of 1 cm between links of 20 cm is below 1 um after them."""
_RIDGE, _LEAST = 1e-6, 1e-9
"""Of the largest entry, and 1/kg, added to the diagonal: two pins may say the same."""


class PinJoints(eqx.Module):
    r"""The pins of a scene, of bodies of these masses.

    In a step the velocities of the two points of a pin agree: with J that maps velocities to their
    difference in the middle of the step, the contact's impulse is the one that makes J v zero,
    applied twice, so that J (v + v') = 0: on a circle the velocity turns and keeps its size. After
    the step a projection in the metric of the masses brings the points together and makes their
    velocities equal, like the constraints of RATTLE (Andersen 1983). Neither adds kinetic energy.
    """

    nodes: Int[Array, "P 2"]
    """See `Nodes.pins`."""
    points: Float[Array, "P 2 D"]
    """m"""
    inverse_mass: Float[Array, "N G"]
    """1/kg; 0 of bodies that never move."""
    turns: Float[Array, " N"]
    """1 for bodies that turn, else 0."""
    turn_length: float = eqx.field(static=True)
    """m; see `generalized_coordinates`."""

    @property
    def exists(self) -> Bool[Array, " P"]:
        """False for padding."""
        return self.nodes[:, 0] != self.nodes[:, 1]

    def geometry(
        self,
        position: Float[Array, "N G"],
        velocity: Float[Array, "N G"],
        motion: Float[Array, "N G"],
    ) -> Geometry:
        """A row each, of points that are together; ``motion`` [m] is what the bodies do in the step
        as far as it is known, in whose middle they meet. Their normals are any: pins act along all
        axes."""
        meeting = self._meeting(position + 0.5 * motion)
        nothing = jnp.zeros_like(meeting.displacement[:, 0])
        return along_normals(
            meeting,
            normal=jnp.zeros_like(meeting.displacement).at[:, 0].set(1.0),
            distance=nothing,
            contact_distance=nothing,
            velocity=velocity,
            motion=jnp.zeros_like(velocity),
        )

    def closed(
        self, position: Float[Array, "N G"], velocity: Float[Array, "N G"]
    ) -> tuple[Float[Array, "N G"], Float[Array, "N G"]]:
        """Position [m] and velocity [m/s] with the points of all pins together.

        Without gradient: a step is linear in its derivatives.
        """
        before = jax.lax.stop_gradient((position, velocity))
        pins, (place, rate) = jax.lax.stop_gradient(self), before
        for _ in range(_CORRECTIONS):
            meeting = pins._meeting(place)
            place = place - pins._least_change(meeting, meeting.displacement)
        meeting = pins._meeting(place)
        rate = rate - pins._least_change(meeting, relative_at_edges(rate, meeting))
        return position + (place - before[0]), velocity + (rate - before[1])

    def _meeting(self, position: Float[Array, "N G"]) -> Meeting:
        """From the first to the second point of every pin."""
        dimension, node = self.points.shape[-1], self.nodes.T
        turn = position[node, dimension] / self.turn_length
        places = position[node, :dimension] + turned(jnp.swapaxes(self.points, 0, 1), turn)
        jacobian = levers(places, position, self.turns, node, self.turn_length)
        moves = self.exists & jnp.any(self.inverse_mass > 0.0, axis=1)[node]
        gap = jnp.where(self.exists[:, None], places[1] - places[0], 0.0)
        return Meeting(gap, jnp.where(moves[..., None, None], jacobian, 0.0), [], node)

    def _least_change(
        self, meeting: Meeting, difference: Float[Array, "P D"]
    ) -> Float[Array, "N G"]:
        """The least change, by mass, of all coordinates that makes up for the differences."""
        rows = dense_jacobian(meeting, len(self.inverse_mass))
        by_mass = rows * self.inverse_mass.ravel()
        matrix = product(by_mass, rows.T)
        ridge = _RIDGE * jnp.max(matrix) + _LEAST
        inverse = dense_inverse(matrix + ridge * jnp.eye(len(matrix), dtype=matrix.dtype))
        change = product(by_mass.T, product(inverse, difference.reshape(-1, 1)))
        return change.reshape(self.inverse_mass.shape)


def pin_joints(
    nodes: Nodes, turns: Float[Array, " N"], mass: Float[Array, "N G"], turn_length: float | None
) -> PinJoints | None:
    """The pins of nodes of this ``mass`` [kg]; None where there are none."""
    if nodes.pins is None or turn_length is None:
        return None
    assert nodes.pin_points is not None
    inverse = jnp.where(nodes.mobile[:, None], 1.0 / mass, 0.0)
    return PinJoints(nodes.pins, nodes.pin_points.astype(mass.dtype), inverse, turns, turn_length)


def joined_with_pins(
    held: Joined, holds: Float[Array, " C"], pins: PinJoints, position: Float[Array, "N G"]
) -> tuple[Joined, Float[Array, " C+P"]]:
    """What ``holds`` (1, else 0), then the pins."""
    jacobian = pins._meeting(position).contact_jacobian
    exists = pins.exists.astype(holds.dtype)
    if not len(holds):
        return Joined(pins.nodes.T, jacobian), exists
    edge_index = jnp.concatenate([held.edge_index, pins.nodes.T], axis=1)
    rows = Joined(edge_index, jnp.concatenate([held.contact_jacobian, jacobian], axis=1))
    return rows, jnp.concatenate([holds, exists])


def with_pins_held(
    holding: Float[Array, " E"], pins: PinJoints | None, geometry: Geometry
) -> Float[Array, " E"]:
    """`Contacts.holding` of edges, 1 where a pin joins their two nodes."""
    if pins is None:
        return holding
    joins, edge = jnp.sort(pins.nodes, axis=1), jnp.sort(geometry.edge_index, axis=0).T
    return jnp.where(jnp.any(jnp.all(edge[:, None] == joins, axis=-1), axis=1), 1.0, holding)


def apart_from_pins(nodes: Nodes) -> Nodes:
    """The nodes, of which those that a pin joins do not touch each other."""
    if nodes.pins is None:
        return nodes
    low, high = jnp.min(nodes.pins, axis=1), jnp.max(nodes.pins, axis=1)
    pinned = jnp.where(low < high, edge_id(low, high), len(nodes.candidate))
    return nodes._replace(candidate=nodes.candidate.at[pinned].set(False, mode="drop"))
