"""From some nodes in play to others: what is known of those who stay in play is kept."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.control.mpc_state import MPCState, Part, Seen
from contactgraph.control.swept import Swept
from contactgraph.data.graph import pair_indices
from contactgraph.model import ContactBelief


def carried_over(
    state: MPCState, who: np.ndarray, part: Part, belief: ContactBelief
) -> MPCState:
    """The state about the nodes ``who`` [n] of its scene, of which this is the ``part``.

    Newcomers begin where they were last seen, at rest or going on as they did then, and are no
    reason for any force; ``belief`` [e, K] is about their edges. Runs on the host.
    """
    assert state.last_seen is not None
    move = _Move(state.who, who)
    position, velocity = (values[np.maximum(who, 0)] for values in state.last_seen)
    motion = np.stack([position, velocity], axis=1)
    seen, plan, swept = state.seen, state.plan, state.swept
    if swept is not None:
        swept = Swept(move.nodes(swept.lower, position), move.nodes(swept.upper, position))
    return replace(
        state,
        belief=move.belief(state.belief, belief),
        plan=replace(
            plan,
            states=move.stacked(plan.states, motion),
            policy=replace(plan.policy, K=move.stacked(plan.policy.K, np.zeros_like(motion))),
            beliefs=move.belief(plan.beliefs, belief),
            who=jnp.asarray(who.astype(np.int32)),
        ),
        seen=Seen(
            position=move.nodes(seen.position, np.where(state.fresh, np.nan, position)),
            velocity=move.nodes(seen.velocity, velocity),
            belief=move.belief(seen.belief, belief),
            told=move.edges(seen.told, np.zeros(1)),
            control=seen.control,
        ),
        swept=swept,
        part=part,
    )


class _Move:
    """Where what is known of nodes and edges goes when others are in play."""

    def __init__(self, before: np.ndarray, after: np.ndarray) -> None:
        """Nodes in play, in their order and then -1 for padding: [m] and [n]."""
        slot = {node: index for index, node in enumerate(before.tolist()) if node >= 0}
        self._node = np.array([slot.get(node, -1) for node in after.tolist()])
        first, second = self._node[pair_indices(len(after))].T
        # Nodes keep their order, so the smaller slot still comes first; see `pair_indices`.
        stays = (first >= 0) & (second >= 0)
        self._edge = np.where(stays, second * (second - 1) // 2 + first, -1)

    def nodes(self, known: jax.Array, new: np.ndarray) -> jax.Array:
        """``known`` […, m, D] and, of newcomers, ``new`` [n, D]."""
        return jnp.asarray(_chosen(np.asarray(known), self._node, new, -2))

    def stacked(self, known: jax.Array, new: np.ndarray) -> jax.Array:
        """``known`` […, 2mD], in `stack_state`'s order, and of newcomers ``new`` [n, 2, D]."""
        by_node = np.asarray(known).reshape(*known.shape[:-1], -1, *new.shape[1:])
        chosen = _chosen(by_node, self._node, new, -3)
        return jnp.asarray(chosen.reshape(*known.shape[:-1], -1))

    def edges(self, known: jax.Array, new: np.ndarray) -> jax.Array:
        """``known`` [e] and, where an edge has a newcomer, ``new`` [1]."""
        return jnp.asarray(_chosen(np.asarray(known), self._edge, new, -1))

    def belief(self, known: ContactBelief, new: ContactBelief) -> ContactBelief:
        """``known`` […, e, K] and, where an edge has a newcomer, ``new`` [e, K]."""
        types, others = np.asarray(known.type_probability), np.asarray(new.type_probability)
        return ContactBelief(jnp.asarray(_chosen(types, self._edge, others, -2)))


def _chosen(known: np.ndarray, index: np.ndarray, new: np.ndarray, axis: int) -> np.ndarray:
    """``known`` at ``index`` along ``axis``, a negative one; ``new`` where the index is -1."""
    kept = np.take(known, np.maximum(index, 0), axis)
    stays = (index >= 0).reshape(-1, *[1] * (-1 - axis))
    return np.where(stays, kept, new).astype(known.dtype)
