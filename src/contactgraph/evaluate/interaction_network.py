"""A small interaction network: the learned baseline without contacts, beliefs or linear dynamics.

After Battaglia et al., Interaction Networks for Learning about Objects, Relations and Physics
(NeurIPS 2016): every ordered pair of bodies sends a message, each body adds up those that it
receives, and the sums give the change of its velocity and position over a step.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from contactgraph.data import Nodes, pair_indices
from contactgraph.data.trajectory_batch import type_id

_WIDTH = 64
_ROUNDS = 2
_FLAGS = 3
"""Whether a body is actuated, static, on a hinge."""


class InputScales(eqx.Module):
    """Typical sizes in the training data, so that the network works with numbers about 1."""

    contact_distance: float
    """m"""
    position: float
    """Spread of positions, m."""
    speed: float
    """m/s"""
    speed_change: float
    """In a step, m/s."""
    control: tuple[float, ...]
    """[U]"""
    dt: float
    """s"""
    turn_length: float | None = None
    """See `generalized_coordinates`. None: no body turns in the plane."""


class MessageRound(eqx.Module):
    """One exchange of messages along all links."""

    receiver: eqx.nn.Linear
    sender: eqx.nn.Linear
    relation: eqx.nn.Linear
    message: eqx.nn.Linear
    update: eqx.nn.MLP

    def __init__(self, relation_size: int, key: PRNGKeyArray) -> None:
        keys = jax.random.split(key, 5)
        self.receiver = eqx.nn.Linear(_WIDTH, _WIDTH, key=keys[0])
        self.sender = eqx.nn.Linear(_WIDTH, _WIDTH, key=keys[1])
        self.relation = eqx.nn.Linear(relation_size, _WIDTH, key=keys[2])
        self.message = eqx.nn.Linear(_WIDTH, _WIDTH, key=keys[3])
        self.update = eqx.nn.MLP(2 * _WIDTH, _WIDTH, _WIDTH, 1, key=keys[4])

    def __call__(
        self, body: Float[Array, "N W"], relation: Float[Array, "N N R"], linked: Array
    ) -> Float[Array, "N W"]:
        """The bodies after the messages; axis 0 of ``relation`` receives."""
        # The first layer of each pair, with its parts computed once a body.
        receiver, sender = jax.vmap(self.receiver)(body), jax.vmap(self.sender)(body)
        pair = jax.vmap(jax.vmap(self.relation))(relation) + receiver[:, None] + sender[None]
        sent = jax.nn.relu(jax.vmap(jax.vmap(self.message))(jax.nn.relu(pair)))
        received = jnp.sum(jnp.where(linked[..., None], sent, 0.0), axis=1)
        return body + jax.vmap(self.update)(jnp.concatenate([body, received], axis=-1))


class InteractionNetwork(eqx.Module):
    """Predicts the next positions and velocities of all bodies."""

    encoder: eqx.nn.MLP
    rounds: tuple[MessageRound, ...]
    decoder: eqx.nn.Linear
    scales: InputScales = eqx.field(static=True)
    types: tuple[int, ...] = eqx.field(static=True)
    """The `type_id` of each type that it knows; of others it knows nothing."""

    def __init__(
        self, dimension: int, types: Sequence[str], scales: InputScales, key: PRNGKeyArray
    ) -> None:
        encoder, decoder, *rounds = jax.random.split(key, 2 + _ROUNDS)
        turns = int(scales.turn_length is not None)
        coordinates = dimension + turns
        # Of a turn the rate, cosine and sine.
        inputs = 3 * (dimension + turns) + len(scales.control) + len(types) + _FLAGS
        self.encoder = eqx.nn.MLP(inputs, _WIDTH, _WIDTH, 1, key=encoder)
        self.rounds = tuple(MessageRound(dimension + coordinates + 2, each) for each in rounds)
        last = eqx.nn.Linear(_WIDTH, 2 * coordinates, key=decoder)
        # It starts as constant velocity.
        self.decoder = jax.tree.map(lambda leaf: 0.01 * leaf, last)
        self.scales, self.types = scales, tuple(map(type_id, types))

    def step(
        self,
        nodes: Nodes,
        position: Float[Array, "N G"],
        velocity: Float[Array, "N G"],
        control: Float[Array, " U"],
    ) -> tuple[Float[Array, "N G"], Float[Array, "N G"]]:
        """The `generalized_coordinates` m and their velocity m/s of each body after a step."""
        scales = self.scales
        place, turn = position, position[:, :0]
        if scales.turn_length is not None:
            place, angle = position[:, :-1], position[:, -1:] / scales.turn_length
            turn = jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        flags = jnp.stack([nodes.actuated, nodes.mask & ~nodes.mobile, nodes.hinged], axis=-1)
        acts = nodes.actuated[:, None] if nodes.control_of is None else nodes.control_of
        arm = 0.0 * place
        if nodes.anchor is not None:
            arm = jnp.where(nodes.hinged[:, None], nodes.anchor - place, 0.0)
        body = [
            velocity / scales.speed,
            place / scales.position,
            turn,
            arm / scales.position,
            acts * control / jnp.asarray(scales.control),
            jnp.asarray(nodes.type_id)[:, None] == np.array(self.types, np.int32),
            flags,
        ]
        hidden = jax.vmap(self.encoder)(jnp.concatenate(body, axis=-1))
        offset = (place[None] - place[:, None]) / scales.contact_distance
        closing = velocity[None] - velocity[:, None]
        moved = scales.dt * closing[..., : place.shape[1]]
        coming = offset + moved / scales.contact_distance
        relation = jnp.concatenate(
            [offset, closing / scales.speed, _length(offset), _length(coming)], axis=-1
        )
        for messages in self.rounds:
            hidden = messages(hidden, relation, links(nodes))
        change = jax.vmap(self.decoder)(hidden) * scales.speed_change
        faster, farther = jnp.split(jnp.where(nodes.mobile[:, None], change, 0.0), 2, axis=-1)
        return position + scales.dt * (velocity + farther), velocity + faster

    def rollout(
        self,
        nodes: Nodes,
        position: Float[Array, "N G"],
        velocity: Float[Array, "N G"],
        controls: Float[Array, "H U"],
    ) -> tuple[Float[Array, "H N G"], Float[Array, "H N G"]]:
        """The positions and velocities after each of the steps under ``controls``."""

        def advance(state: tuple[Array, Array], control: Array) -> tuple[tuple, tuple]:
            after = self.step(nodes, *state, control)
            return after, after

        return jax.lax.scan(advance, (position, velocity), controls)[1]


def links(nodes: Nodes) -> Bool[Array, "N N"]:
    """Pairs that send each other messages."""
    mask = jnp.asarray(nodes.mask)
    first, second = pair_indices(len(mask)).T
    linked = jnp.zeros((len(mask), len(mask)), bool).at[first, second].set(nodes.candidate)
    return (linked | linked.T) & mask[:, None] & mask


def _length(offset: Array) -> Array:
    # The square root has no gradient at 0, where a body meets itself.
    return jnp.sqrt(jnp.sum(offset**2, axis=-1, keepdims=True) + 1e-12)
