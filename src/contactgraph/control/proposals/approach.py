"""Approaches: an actuated body goes to another to push or grasp it, as a policy of few numbers."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from contactgraph.bodies.polygons import vertices_of
from contactgraph.bodies.rotations import placed
from contactgraph.model import Nodes

_ROUND = 1.9
"""Contact distances from the body on the way round."""
_CLEAR = 1.2
"""Contact distances within which it first goes straight away, as its shape may be hooked in."""
_AHEAD = 0.7
"""rad; by how much the hand aims ahead on the way round."""
_BEHIND = 0.87
"""Cosine of the angle to the line of the push within which it goes straight behind the body."""
_BESIDE = 0.5
"""Contact distances beside the line of a push at which the push has slid off."""
_ALIGNED, _GRASPED, _LOST, _PARTED = 0.3, 0.3, 0.5, 1.5
"""Contact distances beside the line of a grasp within which the hand goes on to the body; from the
body within which it closes; and beyond which it, or its touch, holds nothing, believed or not."""
_GAIN = 0.25
"""Part of a distance that is to be covered in a step."""
_TINY = 1e-9


class Approach(eqx.Module):
    """One approach, or a batch of ``S``: which way, from where, how far beside, how fast, how far.

    A grasp goes on to the middle of the body, gives the command there, and takes the body to its
    goal once it holds it. One by touch presses the body until it holds it.
    """

    hand: Int[Array, "*S"]
    """The actuated node that pushes."""
    body: Int[Array, "*S"]
    """The node that is pushed."""
    direction: Float[Array, "*S D"]
    """Of the push, in any length."""
    aside: Float[Array, "*S D"]
    """Contact distances from the body's centre to the line of the push; its part along the
    direction is left out."""
    speed: Float[Array, "*S"]
    """m/s of the push, at most."""
    travel: Float[Array, "*S"]
    """m by which the body is pushed; 0: the hand stays."""
    run_up: Float[Array, "*S"]
    """Contact distances behind the body from which the push begins."""
    swerve: Float[Array, "*S D"]
    """Velocity beside the straight way behind the body, in units of that along it: round what
    stands in the way. Its part along the way is left out."""
    approach_speed: Float[Array, "*S"]
    """m/s on the way behind the body, and with a body held, at most."""
    goal: Float[Array, "*S D"]
    """m; of the body."""
    grasps: Bool[Array, "*S"]
    by_touch: Bool[Array, "*S"]
    """Whether a touch grasps, not fingers round the body; the hand then moves relative to it."""
    command: Float[Array, "*S 2 C"]
    """What components of the control that move nothing are while a body is not grasped, and when
    it is; a push has the second throughout."""

    def at(self, index: Int[Array, " S"]) -> "Approach":
        """Some of a batch."""
        return jax.tree.map(lambda leaf: leaf[index], self)

    def varied(self, draws: "Draws", up: Float[Array, " D"]) -> "Approach":
        """As many near those of a batch as there are draws, which are more; level across ``up``."""
        of = self.at(jnp.arange(len(draws.speed)) % len(self.speed))
        turns = (~of.grasps | of.by_touch)[:, None]
        return dataclasses.replace(
            of,
            direction=of.direction + turns * level(0.15 * draws.direction, up),
            aside=of.aside + 0.1 * ~of.grasps[:, None] * draws.aside,
            speed=of.speed * jnp.exp(0.2 * draws.speed),
            travel=of.travel * jnp.exp(0.15 * draws.travel),
            run_up=of.run_up * jnp.exp(0.1 * draws.run_up),
            swerve=of.swerve + 0.1 * draws.swerve,
            approach_speed=of.approach_speed * jnp.exp(0.2 * draws.approach_speed),
        )

    def wanted(
        self,
        position: Float[Array, "N G"],
        velocity: Float[Array, "N G"],
        held: Bool[Array, ""],
        begin: Float[Array, "N G"],
        contact_distance: Float[Array, ""],
        dt: float,
    ) -> tuple[Float[Array, " D"], Float[Array, " C"]]:
        """The wanted velocity [m/s] of the hand in a step, and the command.

        ``held``: whether the hand holds the body; ``begin``: where the plan started.
        """
        along = unit(self.direction)
        position, begin = position[:, : len(along)], begin[:, : len(along)]
        aside = contact_distance * (self.aside - _dot(self.aside, along) * along)
        at = position[self.body]
        offset = position[self.hand] - at
        back = -_dot(offset, along)
        pushed = _dot(at - begin[self.body], along)
        missing = jnp.where(self.grasps, jnp.maximum(back, 0.0), self.travel - pushed)
        beside = offset + back * along - aside
        speed = jnp.clip(_GAIN * missing / dt, 0.0, self.speed)
        pushing = speed * along - _GAIN * beside / dt

        # Where both ways round are as long, it passes on the side of the last axis.
        outward = unit(offset.at[-1].add(1e-3 * contact_distance))
        turned = jnp.cos(_AHEAD) * outward - jnp.sin(_AHEAD) * unit(
            along - _dot(along, outward) * outward
        )
        near = length(offset) < _CLEAR * contact_distance
        turned = jnp.where(near, outward, turned)
        behind = _dot(outward, along) < -_BEHIND
        wait = aside - self.run_up * contact_distance * along
        aim = jnp.where(behind, wait, _ROUND * contact_distance * turned)
        going = 2.0 * _GAIN * (aim - offset) / dt
        heading = unit(going)
        going += length(going) * (self.swerve - _dot(self.swerve, heading) * heading)
        going = _slower(going, self.approach_speed)
        inside = self.grasps & (length(offset) < _GRASPED * contact_distance)
        near_line = jnp.where(self.grasps, _ALIGNED, _BESIDE) * contact_distance
        ready = (back > 0.0) & (length(beside) < near_line) | inside
        lost = jnp.where(self.by_touch, _PARTED, _LOST) * contact_distance
        carries = self.grasps & held & (length(offset) < lost)
        wanted = jnp.where(self.grasps | (missing > 0.0), jnp.where(ready, pushing, going), 0.0)
        wanted += jnp.where(self.by_touch, velocity[self.body, : len(along)], 0.0)
        carrying = _slower(_GAIN * (self.goal - at) / dt, self.approach_speed)
        command = self.command[jnp.where(self.grasps & ~carries & ~inside, 0, 1)]
        return jnp.where(carries, carrying, wanted), command


class Draws(eqx.Module):
    """Standard normal numbers, from which approaches are made; ``S`` of each."""

    direction: Float[Array, "S D"]
    aside: Float[Array, "S D"]
    swerve: Float[Array, "S D"]
    speed: Float[Array, " S"]
    travel: Float[Array, " S"]
    run_up: Float[Array, " S"]
    approach_speed: Float[Array, " S"]
    command: Float[Array, "S C"]

    @classmethod
    def of(cls, key: PRNGKeyArray, count: int, dimension: int, commands: int) -> "Draws":
        """``count`` new ones."""
        of_vectors, of_numbers, of_commands = jax.random.split(key, 3)
        vectors = jax.random.normal(of_vectors, (3, count, dimension))
        numbers = jax.random.normal(of_numbers, (4, count))
        chosen = jax.random.normal(of_commands, (count, commands))
        return cls(*(*vectors, *numbers, chosen))


def against_gravity(nodes: Nodes, dimension: int) -> Float[Array, " D"]:
    """Unit vector; zeros where bodies have no weight."""
    gravity = jnp.zeros(dimension) if nodes.gravity is None else nodes.gravity
    return -gravity / jnp.maximum(jnp.sqrt(jnp.sum(gravity**2)), 1e-9)


def level_reach(
    nodes: Nodes, position: Float[Array, "N G"], turn_length: float | None
) -> Float[Array, " N"]:
    """By how far outlines reach beside their bodies' positions across gravity, m.

    0 where bodies are round: those without outlines, and all of a model of bodies that do not turn,
    whose ``turn_length`` is None.
    """
    if turn_length is None or nodes.outlines is None:
        return jnp.zeros(len(position))
    vertices = vertices_of(placed(nodes.outlines, position, turn_length))
    dimension = vertices.shape[-1]
    offset = vertices.reshape(len(position), -1, dimension) - position[:, None, :dimension]
    across = level(offset, against_gravity(nodes, dimension))
    return jnp.max(jnp.linalg.norm(across, axis=-1), axis=1)


def level(vector: Float[Array, "*S D"], up: Float[Array, " D"]) -> Float[Array, "*S D"]:
    """The part across ``up``."""
    return vector - _dot(vector, up)[..., None] * up


def _slower(velocity: Float[Array, "*S D"], most: Float[Array, "*S"]) -> Float[Array, "*S D"]:
    return velocity * jnp.minimum(1.0, most / length(velocity))[..., None]


def _dot(one: Float[Array, "*S D"], other: Float[Array, "*S D"]) -> Float[Array, "*S"]:
    return jnp.sum(one * other, axis=-1)


def length(vector: Float[Array, "*S D"]) -> Float[Array, "*S"]:
    """Never zero."""
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + _TINY)


def unit(vector: Float[Array, "*S D"]) -> Float[Array, "*S D"]:
    """The same direction in length 1."""
    return vector / length(vector)[..., None]
