"""Approaches: an actuated body goes to another to push or grasp it, as a policy of few numbers."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from contactgraph.bodies.polygons import vertices_of
from contactgraph.bodies.rotations import placed
from contactgraph.model import Nodes

_STAND_OFF, _ROUND = 1.5, 1.9
"""Contact distances from the body: where a push begins at the nearest, and on the way round."""
_FASTEST = 1.5
"""Greatest speed of pushes, in units of the top speed."""
_BANKED = 0.1
"""Spread about the line to an image of the goal."""
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
        along = _unit(self.direction)
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
        outward = _unit(offset.at[-1].add(1e-3 * contact_distance))
        turned = jnp.cos(_AHEAD) * outward - jnp.sin(_AHEAD) * _unit(
            along - _dot(along, outward) * outward
        )
        near = _length(offset) < _CLEAR * contact_distance
        turned = jnp.where(near, outward, turned)
        behind = _dot(outward, along) < -_BEHIND
        wait = aside - self.run_up * contact_distance * along
        aim = jnp.where(behind, wait, _ROUND * contact_distance * turned)
        going = 2.0 * _GAIN * (aim - offset) / dt
        heading = _unit(going)
        going += _length(going) * (self.swerve - _dot(self.swerve, heading) * heading)
        going = _slower(going, self.approach_speed)
        inside = self.grasps & (_length(offset) < _GRASPED * contact_distance)
        near_line = jnp.where(self.grasps, _ALIGNED, _BESIDE) * contact_distance
        ready = (back > 0.0) & (_length(beside) < near_line) | inside
        lost = jnp.where(self.by_touch, _PARTED, _LOST) * contact_distance
        carries = self.grasps & held & (_length(offset) < lost)
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


def spread_approaches(
    draws: Draws,
    hand: Int[Array, " S"],
    body: Int[Array, " S"],
    goal: Float[Array, "S D"],
    aim: Float[Array, "S D"],
    turn: Float[Array, " S"],
    position: Float[Array, "N D"],
    top_speed: float,
    up: Float[Array, " D"],
    commands: tuple[Float[Array, " C"], Float[Array, " C"]],
    touch_holds: bool,
) -> Approach:
    """Approaches of all sides, every second one near the line to the goal; the first one stays.

    Speeds are spread evenly by their logarithm, from a twelfth of ``top_speed`` [m/s] to 1.5 times
    it; on the way from a third to all of it. Half of them swerve. With commands and a direction
    ``up`` all others are grasps, from above: pushing with fingers is seldom seen in what a model
    learned from.

    ``goal`` and ``aim``: [m] of each body, and where to push it, which is the goal or an image of
    it; ``turn`` [m]: how far it is to turn, which takes pushes from any side; ``position``: [m];
    ``up``: a unit vector along which none pushes, or zeros; ``commands``: least and greatest value
    of each; ``touch_holds``: whether a touch may hold, which every fourth one then tries.
    """
    missing = aim - position[body]
    distance = jnp.sqrt(_length(missing) ** 2 + turn**2)
    grasps = (jnp.arange(len(hand)) > 0) & jnp.any(up != 0.0) & (draws.command.shape[1] > 0)
    by_touch = (jnp.arange(len(hand)) % 4 == 2) & touch_holds
    high = jnp.where(draws.command > 0.0, commands[1], commands[0])
    banked = jnp.any(aim != goal, axis=-1)[:, None]
    wide = jnp.where(jnp.arange(len(hand)) % 2 == 0, 1.0, 0.25)[:, None]
    wide = jnp.where(banked, _BANKED, wide)
    direction = missing / distance[:, None] + wide * draws.direction
    straight = _unit(position[body] - position[hand]) + wide * draws.direction
    direction = jnp.where(by_touch[:, None], straight, direction)
    travel = distance * jnp.exp(0.3 * draws.travel)
    return Approach(
        hand=hand,
        body=body,
        direction=jnp.where(grasps[:, None], -up, _unit(_level(direction, up))),
        aside=jnp.where(
            (grasps | by_touch)[:, None], 0.0, jnp.where(banked, _BANKED, 0.3) * draws.aside
        ),
        speed=_FASTEST * top_speed * jnp.exp(-2.9 * jax.scipy.stats.norm.cdf(draws.speed)),
        travel=travel.at[0].set(0.0),
        run_up=_STAND_OFF * jnp.exp(jax.scipy.stats.norm.cdf(draws.run_up)),
        swerve=jnp.where((jnp.arange(len(hand)) % 4 < 2)[:, None], 0.0, draws.swerve),
        approach_speed=top_speed * jnp.exp(-jax.scipy.stats.norm.cdf(draws.approach_speed)),
        goal=goal,
        grasps=grasps | by_touch,
        by_touch=by_touch,
        command=jnp.stack([commands[0] + commands[1] - high, high], axis=1),
    )


def varied_approaches(draws: Draws, approaches: Approach, up: Float[Array, " D"]) -> Approach:
    """As many approaches near the given ones, of which there are fewer, as there are draws."""
    of = approaches.at(jnp.arange(len(draws.speed)) % len(approaches.speed))
    turns = (~of.grasps | of.by_touch)[:, None]
    return dataclasses.replace(
        of,
        direction=of.direction + turns * _level(0.15 * draws.direction, up),
        aside=of.aside + 0.1 * ~of.grasps[:, None] * draws.aside,
        speed=of.speed * jnp.exp(0.2 * draws.speed),
        travel=of.travel * jnp.exp(0.15 * draws.travel),
        run_up=of.run_up * jnp.exp(0.1 * draws.run_up),
        swerve=of.swerve + 0.1 * draws.swerve,
        approach_speed=of.approach_speed * jnp.exp(0.2 * draws.approach_speed),
    )


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
    level = _level(offset, against_gravity(nodes, dimension))
    return jnp.max(jnp.linalg.norm(level, axis=-1), axis=1)


def _level(vector: Float[Array, "*S D"], up: Float[Array, " D"]) -> Float[Array, "*S D"]:
    return vector - _dot(vector, up)[..., None] * up


def _slower(velocity: Float[Array, "*S D"], most: Float[Array, "*S"]) -> Float[Array, "*S D"]:
    return velocity * jnp.minimum(1.0, most / _length(velocity))[..., None]


def _dot(one: Float[Array, "*S D"], other: Float[Array, "*S D"]) -> Float[Array, "*S"]:
    return jnp.sum(one * other, axis=-1)


def _length(vector: Float[Array, "*S D"]) -> Float[Array, "*S"]:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + _TINY)


def _unit(vector: Float[Array, "*S D"]) -> Float[Array, "*S D"]:
    return vector / _length(vector)[..., None]
