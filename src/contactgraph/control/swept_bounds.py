"""Bounds of the trial rollouts of a plan, and the nodes that may affect it.

A node that no moving node approaches in any rollout stays at rest and does not affect the plan. A
rejected rollout counts only up to the step at which its cost exceeds the best one's, since later
steps cannot change the rejection. Nodes outside a plan are not predicted. Their travel is bounded
by that of the fastest of them, because the ground slows them down and only they touch each other.
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.control.host import Motion
from contactgraph.control.rollout import Rollout
from contactgraph.model import InteractionCutoff, Nodes

_STILL = 0.005
"""Part of the cutoff: a node that moves by less in every rollout has not been struck."""
_SLACK = 0.05
"""Part of the cutoff, added to it: springs and controls hardly move nodes without a contact."""
_LEAVES = 0.5
"""Part of the cutoff, beyond it, at which a node leaves the active set; it prevents flicker."""


class SweptBounds(eqx.Module):
    """Boxes around all positions of a node in a step of a rollout, one each of ``R`` rollouts.

    They contain the positions that `contactgraph.model.collision` uses: the start of the step, its
    end without contact, and its predicted end. The box of a hinged body contains the whole bar.
    """

    lower: Float[Array, "R H N D"]
    """m"""
    upper: Float[Array, "R H N D"]
    """m"""

    @classmethod
    def empty(cls, rollouts: int, horizon: int, like: Float[Array, "N D"]) -> "SweptBounds":
        """Boxes that contain nothing yet."""
        nothing = jnp.full((rollouts, horizon, *like.shape), jnp.inf, like.dtype)
        return cls(nothing, -nothing)

    def with_rollout(
        self,
        index: Int[Array, ""],
        rollout: Rollout,
        counts: Bool[Array, " H"],
        nodes: Nodes,
        dt: float,
    ) -> "SweptBounds":
        """With the rollout of this index, in those steps of ``dt`` [s] that count."""
        position = rollout.position[:-1]
        # A parabola lies within its ends and the point where its tangents meet.
        middle = position + 0.5 * dt * rollout.velocity[:-1]
        unhindered = position + dt * rollout.velocity[:-1] + rollout.control_displacement
        lower, upper = _boxes([position, middle, unhindered, rollout.position[1:]], nodes)
        counts = counts[:, None, None]
        lower, upper = jnp.where(counts, lower, jnp.inf), jnp.where(counts, upper, -jnp.inf)
        return SweptBounds(
            self.lower.at[index].set(lower.astype(self.lower.dtype)),
            self.upper.at[index].set(upper.astype(self.upper.dtype)),
        )

    def including(self, positions: list[np.ndarray], nodes: Nodes) -> "SweptBounds":
        """With these positions [N, D] m in all boxes, on the host."""
        lower, upper = _boxes(positions, nodes, np)
        return SweptBounds(
            np.minimum(self.lower, lower).astype(self.lower.dtype),
            np.maximum(self.upper, upper).astype(self.upper.dtype),
        )


def _boxes(positions: list[Any], nodes: Nodes, xp: Any = jnp) -> tuple[Any, Any]:
    """Bounds [*H, N, D] of those positions [*H, N, D] m that are finite; ``xp``: jnp or np."""
    if nodes.anchor is not None:
        anchor = xp.nan_to_num(xp.asarray(nodes.anchor))
        hinged = xp.asarray(nodes.hinged)[:, None]
        positions = [
            *[xp.where(hinged, 2.0 * position - anchor, position) for position in positions],
            xp.where(hinged, anchor, positions[0]),
        ]
    stacked = xp.stack(positions)
    known = xp.isfinite(stacked)
    lower = xp.min(xp.where(known, stacked, xp.inf), axis=0)
    return lower, xp.max(xp.where(known, stacked, -xp.inf), axis=0)


@dataclass(frozen=True, eq=False)
class ActiveBounds:
    """The swept bounds of the active nodes, on the host."""

    swept: SweptBounds
    node_ids: np.ndarray
    """[n] of the active nodes; -1 for padding."""
    required: np.ndarray
    """[n] bool: nodes that are active wherever they are."""
    cutoff: InteractionCutoff

    def nodes_to_add(self, others: np.ndarray, motion: Motion, cutoffs: float = 1.0) -> np.ndarray:
        """Those of the inactive nodes ``others`` [r] that should have been active, nearest first.

        ``motion`` is of all nodes. With more ``cutoffs`` than one, those follow that are as many
        cutoffs away, and may matter to the next plan.
        """
        position, speed = motion[0][others], _norm(motion[1][others])
        lower, upper = np.asarray(self.swept.lower), np.asarray(self.swept.upper)
        horizon = lower.shape[1]
        fast = self._is_fast(speed)
        radius = cutoffs * (1.0 + _SLACK) * self.cutoff.distance
        drift = self.cutoff.dt * np.max(speed, where=~fast, initial=0.0)
        # Most nodes are far from everything: one box around all bounds excludes them.
        margin = radius + drift * horizon
        low, high = lower.min(axis=(0, 1, 2)) - margin, upper.max(axis=(0, 1, 2)) + margin
        near = np.all((position > low) & (position < high), axis=1) & ~fast
        if not near.any():
            return others[fast]
        movers = np.flatnonzero(self._movers())
        point = position[near, None, None, None]
        outside = np.maximum(lower[..., movers, :] - point, point - upper[..., movers, :])
        radii = radius + drift * np.arange(1, horizon + 1)[:, None]
        margins = np.full(len(others), np.inf)
        margins[near] = np.min(_norm(np.maximum(outside, 0.0)) - radii, axis=(1, 2, 3))
        margins[fast] = -np.inf
        added = np.flatnonzero(margins < 0.0)
        return others[added[np.argsort(margins[added], kind="stable")]]

    def nodes_to_keep(self, motion: Motion) -> np.ndarray:
        """Those of the active nodes that a moving one came near; ``motion`` is of all nodes."""
        lower, upper = np.asarray(self.swept.lower), np.asarray(self.swept.upper)
        one_sided = lower[..., :, None, :] - upper[..., None, :, :]
        gap = np.maximum(np.maximum(one_sided, np.swapaxes(one_sided, -3, -2)), 0.0)
        near = np.any(_norm(gap) < (1.0 + _LEAVES) * self.cutoff.distance, axis=(0, 1))
        movers, exists = self._movers(), self.node_ids >= 0
        kept = (self.required | self._is_fast(_norm(motion[1][self.node_ids]))) & exists
        for _ in self.node_ids:
            kept = kept | (near[kept & movers].any(axis=0) & exists)
        return self.node_ids[kept]

    def _movers(self) -> np.ndarray:
        """[n] All but the nodes that are active for being near, and at rest in every rollout."""
        lower, upper = np.asarray(self.swept.lower), np.asarray(self.swept.upper)
        extent = upper.max(axis=(0, 1)) - lower.min(axis=(0, 1))
        moves = np.max(extent, axis=-1) > _STILL * self.cutoff.distance
        return (moves | self.required) & (self.node_ids >= 0)

    def _is_fast(self, speed: np.ndarray) -> np.ndarray:
        """Whether nodes of such a speed, m/s, travel farther in a plan than the cutoff."""
        horizon = np.asarray(self.swept.lower).shape[1]
        return speed * self.cutoff.dt * horizon > self.cutoff.distance


def _norm(vector: np.ndarray) -> np.ndarray:
    # Observations may be huge: unlike a power, this overflows without a warning.
    return np.sqrt(np.einsum("...d,...d->...", vector, vector))
