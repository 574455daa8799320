"""Ours beside a peer: the same data, interleaved rounds, medians, and how far the answers agree.

Every benchmark that has a peer ends in rows of the same form, which `table.py` gathers: what was
measured, our time, the peer and its time, the ratio (above 1: ours is faster), and the agreement,
the largest difference of the answers, every array's as a fraction of its largest entry. A peer that
is not installed gives a row that says so.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

Row = dict[str, Any]
FULL_S, QUICK_S = 10.0, 0.2
"""For so long the rounds of a comparison go on."""
MOST_ROUNDS = 1000


@dataclass(frozen=True)
class Way:
    """One way to get an answer."""

    name: str
    run: Callable[[], Any]
    """Returns when the answer is there."""
    answer: Callable[[Any], Any] = np.asarray
    """Of what `run` returned, arrays that are comparable with those of other ways."""


@dataclass(frozen=True)
class Missing:
    """A peer that cannot be run here."""

    name: str
    reason: str


def compared(what: str, ours: Way, peers: Sequence[Way | Missing], quick: bool) -> list[Row]:
    """One row a peer. The ways take turns, so that what else the machine does meets all of them."""
    present = [peer for peer in peers if isinstance(peer, Way)]
    ways = [ours, *present]
    answers = [way.answer(way.run()) for way in ways]  # compiles, too
    seconds: list[list[float]] = [[] for _ in ways]
    until = time.perf_counter() + (QUICK_S if quick else FULL_S)
    while not seconds[0] or (time.perf_counter() < until and len(seconds[0]) < MOST_ROUNDS):
        for way, spent in zip(ways, seconds, strict=True):
            began = time.perf_counter()
            way.run()
            spent.append(time.perf_counter() - began)
    mine = np.asarray(seconds[0])
    rows = [
        _row(
            what,
            mine,
            peer.name,
            np.asarray(spent),
            f"{difference(answer, answers[0]):.0e}",
        )
        for peer, spent, answer in zip(present, seconds[1:], answers[1:], strict=True)
    ]
    for peer in peers:
        if isinstance(peer, Missing):
            print(f"{what}: {peer.name} is left out: {peer.reason}")
            rows.append(_row(what, mine, f"{peer.name}: {peer.reason}", None, ""))
    return rows


def difference(answer: Any, reference: Any) -> float:
    """The largest over all arrays, as a fraction of the reference's largest entry."""

    def apart(ours: np.ndarray, theirs: np.ndarray) -> float:
        gap = np.abs(np.asarray(ours, np.float64) - theirs)
        return float(np.max(gap) / (np.max(np.abs(theirs)) or 1.0))

    return max(jax.tree.leaves(jax.tree.map(apart, answer, reference)))


def _row(what: str, ours: np.ndarray, peer: str, theirs: np.ndarray | None, agreement: str) -> Row:
    return {
        "what": what,
        "ours ms": 1e3 * float(np.median(ours)),
        "peer": peer,
        "peer ms": None if theirs is None else 1e3 * float(np.median(theirs)),
        "ratio": None if theirs is None else float(np.median(theirs / ours)),
        "agreement": agreement,
        "rounds": len(ours),
    }
