"""Turns of bodies: angles in the plane, rotation vectors in space; and what moves with them.

The direction of a rotation vector is an axis in the world and its length an angle, in rad. It tells
the orientation of a body from that of its frame; whole turns about that axis make no difference.
Angular velocities are about the body's own axes, in which its inertia is constant.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

_SMALL = 1e-12
_WHOLE = 2.0 * np.pi


def rotation_matrix(turn: Float[Array, "*C 3"]) -> Float[Array, "*C 3 3"]:
    """Of rotation vectors [rad], by the formula of Rodrigues."""
    square = jnp.sum(turn**2, axis=-1)
    angle = jnp.sqrt(square + _SMALL)
    sine, versine = jnp.sin(angle) / angle, (1.0 - jnp.cos(angle)) / (square + _SMALL)
    cross = skew(turn)
    whole = jnp.eye(3, dtype=turn.dtype)
    return whole + sine[..., None, None] * cross + versine[..., None, None] * (cross @ cross)


def skew(vector: Float[Array, "*C 3"]) -> Float[Array, "*C 3 3"]:
    """The matrix of the cross product of each vector with another."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = jnp.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return jnp.stack(rows, axis=-1).reshape(*vector.shape, 3)


def composed(turn: Float[Array, "*C 3"], by: Float[Array, "*C 3"]) -> Float[Array, "*C 3"]:
    """The rotation vector [rad] of a body that turns on ``by`` another one, about its own axes.

    Of those that differ by whole turns, the one nearest to the sum of both.
    """
    (one, first), (other, second) = _quaternion(turn), _quaternion(by)
    scalar = one * other - jnp.sum(first * second, axis=-1, keepdims=True)
    vector = one * second + other * first + jnp.cross(first, second)
    square, target = jnp.sum(vector**2, axis=-1, keepdims=True), turn + by
    small = square < _SMALL
    length = jnp.sqrt(jnp.where(small, 1.0, square))
    # Of a whole turn the axis is known from the sum alone.
    along = target / jnp.sqrt(jnp.sum(target**2, axis=-1, keepdims=True) + _SMALL)
    axis = jnp.where(small, along, vector / length)
    angle = jnp.where(small, 0.0, 2.0 * jnp.arctan2(length, scalar))
    missing = jnp.sum(target * axis, axis=-1, keepdims=True) - angle
    exact = (angle + _WHOLE * jnp.round(missing / _WHOLE)) * axis
    return jnp.where(small & (jnp.abs(missing) < 1.0), target, exact)


def _quaternion(turn: Float[Array, "*C 3"]) -> tuple[Float[Array, "*C 1"], Float[Array, "*C 3"]]:
    """The scalar and the vector of a unit quaternion."""
    half = 0.5 * jnp.sqrt(jnp.sum(turn**2, axis=-1, keepdims=True) + _SMALL)
    return jnp.cos(half), 0.5 * jnp.sin(half) / half * turn


def levers(
    points: Float[Array, "*C D"],
    position: Float[Array, "N G"],
    turns: Float[Array, " N"],
    node: Int[Array, "*C"],
    turn_length: float,
) -> Float[Array, "*C D G"]:
    """Maps the velocity of the bodies ``node`` to that of their ``points`` [m]."""
    dimension = points.shape[-1]
    arm = points - position[node, :dimension]
    if dimension == 2:
        turning = across(arm)[..., None]
    else:
        turning = -skew(arm) @ rotation_matrix(position[:, 3:] / turn_length)[node]
    turning = turning * (turns[node] / turn_length)[..., None, None]
    whole = jnp.broadcast_to(jnp.eye(dimension, dtype=points.dtype), (*arm.shape, dimension))
    return jnp.concatenate([whole, turning], axis=-1)


def turned(vector: Float[Array, "... 2"], angle: Float[Array, "..."]) -> Float[Array, "... 2"]:
    """The vectors, turned by ``angle`` [rad]."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def across(vector: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """The vectors, turned by a quarter: the velocity at that place of a body that turns by 1 /s."""
    return jnp.stack([-vector[..., 1], vector[..., 0]], axis=-1)


def placed(
    outlines: Float[Array, "N ... D"],
    position: Float[Array, "N G"],
    turn_length: float,
) -> Float[Array, "N ... D"]:
    """The outlines [m] of bodies at these positions and turns: see `generalized_coordinates`."""
    dimension, apart = outlines.shape[-1], (1,) * (outlines.ndim - 2)
    turn = position[:, dimension:] / turn_length
    centre = position[:, :dimension].reshape(len(position), *apart, dimension)
    if dimension == 2:
        return centre + turned(outlines, turn.reshape(len(turn), *apart))
    return centre + jnp.einsum("nij,n...j->n...i", rotation_matrix(turn), outlines)


def stepped_turns(
    before: Float[Array, "*T N G"], after: Float[Array, "*T N G"], turn_length: float
) -> Float[Array, "*T N G"]:
    """Coordinates in space after a step, if turns did not add up as they do in ``after``.

    Without gradient: a step is linear in its derivatives.
    """
    turn, then = before[..., 3:] / turn_length, after[..., 3:] / turn_length
    off = jax.lax.stop_gradient(composed(turn, then - turn) - then)
    return after.at[..., 3:].add(turn_length * off)
