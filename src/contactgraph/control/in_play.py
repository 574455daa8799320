"""Who is in play: which nodes of a scene can matter to a plan. Numpy, on the host, once a tick.

Always in play is what the control acts on, what the cost is about, what hangs on a hinge (its body
is longer than its node says), and what moves so fast that it may come from anywhere. Who else is in
play depends on where the search for a plan has been (`SweptBounds`). What comes near nobody who
moves, in any rollout, stays as it is and has not mattered. For want of a prediction of their own,
nodes left out are taken to get no farther than the fastest of them would: they are slowed down by
the ground and pushed by each other, by nothing else.
"""

from dataclasses import dataclass

import numpy as np

from contactgraph.control.cost import QuadraticCost
from contactgraph.control.host import Motion
from contactgraph.control.swept_bounds import SweptBounds
from contactgraph.model import InteractionCutoff, Nodes

_STILL = 0.005
"""Of the reach: who moves by less in every rollout was struck by nobody."""
_SLACK = 0.05
"""Of the reach, by which it is taken to be longer: springs and controls hardly move bystanders."""
_LEAVES = 0.5
"""Of the reach, beyond it, from which on a node is no longer in play: nobody comes and goes."""
_SMALLEST, _TIMES = 2, 3
"""Rooms: for so many nodes, and each for so many times as many as the one before."""
_HARDLY_MORE = 1.5
_SMALL = 4
"""Scenes of up to so many nodes are planned as a whole."""


def room_for(count: int, capacity: int) -> int:
    """For how many nodes the tick is compiled in which ``count`` are in play: 2, 6, 18, …, or all
    where they are hardly more: every room is a program."""
    room = _SMALLEST
    while room < count:
        room *= _TIMES
    return room if room * _HARDLY_MORE <= capacity else capacity


def rooms(least: int, most: int, capacity: int) -> list[int]:
    """All that there are for ``least`` to ``most`` nodes."""
    counts = range(least, max(least, most) + 1)
    return sorted({room_for(count, capacity) for count in counts})


def padded(nodes: np.ndarray, room: int) -> np.ndarray:
    """[room] The numbers of the nodes in their order, then -1."""
    return np.concatenate([np.sort(nodes), np.full(room - len(nodes), -1)]).astype(np.int64)


def always_in_play(nodes: Nodes, cost: QuadraticCost) -> np.ndarray:
    """[m] Nodes that matter wherever things are. Of few it is not worth while to choose."""
    mask = np.asarray(nodes.mask)
    if cost.involved is None or len(mask) <= _SMALL:
        return np.arange(len(mask))
    needed = np.array(nodes.actuated)
    if nodes.anchor is not None:
        needed |= np.isfinite(np.asarray(nodes.anchor)[:, 0])
    needed[np.asarray(cost.involved)] = True
    return np.flatnonzero(needed & mask)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What a tick has seen of the nodes that were not in play."""

    nodes: np.ndarray
    """[r] Their numbers."""
    position: np.ndarray
    """[r, D] m"""
    speed: np.ndarray
    """[r] m/s"""

    @classmethod
    def seen(cls, nodes: np.ndarray, motion: Motion) -> "Surroundings":
        """From the motion of all nodes."""
        position, velocity = motion
        return cls(nodes, position[nodes], _length(velocity[nodes]))

    def missing(
        self,
        swept: SweptBounds,
        who: np.ndarray,
        always: np.ndarray,
        locality: InteractionCutoff,
        reaches: float = 1.0,
    ) -> np.ndarray:
        """Those who should have been in play with ``who`` [n], most urgent first.

        ``always`` [n] bool: who of these is in play wherever things are. With more ``reaches``
        than one those follow who are that near, and may matter to another search.
        """
        lower, upper = np.asarray(swept.lower), np.asarray(swept.upper)
        horizon = lower.shape[1]
        fast = _is_fast(self.speed, horizon, locality)
        radius = reaches * (1.0 + _SLACK) * locality.distance
        drift = locality.dt * np.max(self.speed, where=~fast, initial=0.0)
        # Nearly all are far from everything: told by one box around all that was swept.
        margin = radius + drift * horizon
        low, high = lower.min(axis=(0, 1, 2)) - margin, upper.max(axis=(0, 1, 2)) + margin
        near = np.all((self.position > low) & (self.position < high), axis=1) & ~fast
        if not near.any():
            return self.nodes[fast]
        movers = np.flatnonzero(_matter(swept, who, always, locality))
        place = self.position[near, None, None, None]
        outside = np.maximum(lower[..., movers, :] - place, place - upper[..., movers, :])
        radii = radius + drift * np.arange(1, horizon + 1)[:, None]
        margins = np.full(len(self.nodes), np.inf)
        margins[near] = np.min(_length(np.maximum(outside, 0.0)) - radii, axis=(1, 2, 3))
        margins[fast] = -np.inf
        found = np.flatnonzero(margins < 0.0)
        return self.nodes[found[np.argsort(margins[found], kind="stable")]]


def staying(
    swept: SweptBounds,
    who: np.ndarray,
    always: np.ndarray,
    motion: Motion,
    locality: InteractionCutoff,
) -> np.ndarray:
    """Those of ``who`` [n] in play who matter still: whom something that moves came near.

    ``always`` [n] bool: who of these always matters. ``motion`` is of all nodes.
    """
    lower, upper = np.asarray(swept.lower), np.asarray(swept.upper)
    one_way = lower[..., :, None, :] - upper[..., None, :, :]
    gap = np.maximum(np.maximum(one_way, np.swapaxes(one_way, -3, -2)), 0.0)
    near = np.any(_length(gap) < (1.0 + _LEAVES) * locality.distance, axis=(0, 1))
    movers = _matter(swept, who, always, locality)
    fast = _is_fast(_length(motion[1][who]), lower.shape[1], locality)
    stays = (always | fast) & (who >= 0)
    for _ in who:
        stays = stays | (near[stays & movers].any(axis=0) & (who >= 0))
    return who[stays]


def _matter(
    swept: SweptBounds, who: np.ndarray, always: np.ndarray, locality: InteractionCutoff
) -> np.ndarray:
    """[n] Which of those in play others must not be near without being in play: all but those
    at rest, whatever was tried, who are in play because they were near themselves."""
    extent = np.asarray(swept.upper).max(axis=(0, 1)) - np.asarray(swept.lower).min(axis=(0, 1))
    moves = np.max(extent, axis=-1) > _STILL * locality.distance
    return (moves | always) & (who >= 0)


def _is_fast(speed: np.ndarray, horizon: int, locality: InteractionCutoff) -> np.ndarray:
    """Whether nodes of such a speed, m/s, may get farther in a plan than the model reaches."""
    return speed * locality.dt * horizon > locality.distance


def _length(vector: np.ndarray) -> np.ndarray:
    # What is told of may be anywhere: unlike a power, this overflows without a warning.
    return np.sqrt(np.einsum("...d,...d->...", vector, vector))
