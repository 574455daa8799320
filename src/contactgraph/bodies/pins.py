r"""Pins: joints of two bodies that let them turn, as rows and as a projection after the step.

In a step the velocities of the two points of a pin agree: with J that maps velocities to their
difference in the middle of the step, the contact's impulse is the one that makes J v zero, applied
twice, so that J (v + v') = 0: on a circle the velocity turns and keeps its size. After the step a
projection in the metric of the masses brings the points together and makes their velocities equal,
like the constraints of RATTLE (Andersen 1983). Neither adds kinetic energy.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.geometry import Geometry, Meeting, Rows, along_normals
from contactgraph.bodies.graph import Bodies
from contactgraph.bodies.mass_matrix import dense_inverse, product
from contactgraph.bodies.rotations import levers, turned
from contactgraph.data.graph import edge_id
from contactgraph.data.trajectory_batch import Nodes

_CORRECTIONS = 2
"""Newton iterations: a gap of 1 cm between links of 20 cm is below 1 um after them."""
_RIDGE, _LEAST = 1e-6, 1e-9
"""Of the largest entry, and 1/kg, added to the diagonal: two pins may say the same."""


def pin_meeting(bodies: Bodies, turn_length: float | None) -> Meeting:
    """From the first to the second point of every pin; no rows where nothing turns or is pinned.

    ``turn_length`` [m]: see `generalized_coordinates`.
    """
    position, nodes = bodies.position, bodies.nodes
    if nodes.pins is None or turn_length is None:
        nothing = jnp.zeros((0, position.shape[1]), position.dtype)
        return Meeting(jnp.zeros((2, 0), int), jnp.zeros((2, 0, 1, 1)), nothing, [])
    node, points = nodes.pins.T, jnp.asarray(nodes.pin_points, position.dtype)
    dimension = points.shape[-1]
    turn = position[node, dimension] / turn_length
    places = position[node, :dimension] + turned(jnp.swapaxes(points, 0, 1), turn)
    jacobian = levers(places, position, bodies.turns, node, turn_length)
    exists = node[0] != node[1]
    moves = exists & nodes.mobile[node]
    gap = jnp.where(exists[:, None], places[1] - places[0], 0.0)
    return Meeting(node, jnp.where(moves[..., None, None], jacobian, 0.0), gap, [])


def pinned(rows: Rows) -> Float[Array, " P"]:
    """1 for the pins of a `pin_meeting`, 0 for padding."""
    return (rows.edge_index[0] != rows.edge_index[1]).astype(rows.contact_jacobian.dtype)


def pin_geometry(
    bodies: Bodies, motion: Float[Array, "N G"], turn_length: float | None
) -> Geometry:
    """A row each, of points that are together; ``motion`` [m] is what the bodies do in the step as
    far as it is known, in whose middle they meet. Their normals are any: pins act along all axes.
    """
    middle = bodies._replace(position=bodies.position + 0.5 * motion)
    meeting = pin_meeting(middle, turn_length)
    nothing = jnp.zeros_like(meeting.displacement[:, 0])
    return along_normals(
        meeting,
        normal=jnp.zeros_like(meeting.displacement).at[:, 0].set(1.0),
        distance=nothing,
        contact_distance=nothing,
        velocity=bodies.velocity,
        motion=jnp.zeros_like(bodies.velocity),
    )


def with_closed_pins(bodies: Bodies, mass: Float[Array, "N G"], turn_length: float) -> Bodies:
    """The bodies, of this ``mass`` [kg], with the points of all pins together.

    Without gradient: a step is linear in its derivatives.
    """
    fixed, mass = jax.lax.stop_gradient((bodies, mass))
    inverse = jnp.where(fixed.nodes.mobile[:, None], 1.0 / mass, 0.0)

    def least_change(meeting: Meeting, difference: Float[Array, "P D"]) -> Float[Array, "N G"]:
        """The least change, by mass, of all coordinates that makes up for the differences."""
        rows = meeting.dense(len(inverse))
        by_mass = rows * inverse.ravel()
        matrix = product(by_mass, rows.T)
        ridge = _RIDGE * jnp.max(matrix) + _LEAST
        whole = dense_inverse(matrix + ridge * jnp.eye(len(matrix), dtype=matrix.dtype))
        change = product(by_mass.T, product(whole, difference.reshape(-1, 1)))
        return change.reshape(inverse.shape)

    place, rate = fixed.position, fixed.velocity
    for _ in range(_CORRECTIONS):
        meeting = pin_meeting(fixed._replace(position=place), turn_length)
        place = place - least_change(meeting, meeting.displacement)
    meeting = pin_meeting(fixed._replace(position=place), turn_length)
    rate = rate - least_change(meeting, meeting.relative(rate))
    return bodies._replace(
        position=bodies.position + (place - fixed.position),
        velocity=bodies.velocity + (rate - fixed.velocity),
    )


def with_pins_held(holding: Float[Array, " E"], pins: Rows, edges: Rows) -> Float[Array, " E"]:
    """`Contacts.holding` of edges, 1 where a pin joins their two nodes."""
    joins, edge = jnp.sort(pins.edge_index, axis=0).T, jnp.sort(edges.edge_index, axis=0).T
    return jnp.where(jnp.any(jnp.all(edge[:, None] == joins, axis=-1), axis=1), 1.0, holding)


def apart_from_pins(nodes: Nodes) -> Nodes:
    """The nodes, of which those that a pin joins do not touch each other."""
    if nodes.pins is None:
        return nodes
    low, high = jnp.min(nodes.pins, axis=1), jnp.max(nodes.pins, axis=1)
    pinned = jnp.where(low < high, edge_id(low, high), len(nodes.candidate))
    return nodes._replace(candidate=nodes.candidate.at[pinned].set(False, mode="drop"))
