"""Shared by the benchmarks: options, machine, timing, comparison with peers, output.

Every benchmark that has a peer ends in rows of one form, which `table.py` gathers: the measured
thing, our time, the peer and its time, the ratio (above 1: ours is faster), and the agreement: the
largest difference of the answers, that of every array as a fraction of its largest entry. A peer
that is not installed gives a row that says so.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

Row = dict[str, Any]
FULL_S, QUICK_S = 10.0, 0.2
"""Duration of the rounds of a comparison."""
MAX_ROUNDS = 1000


def arguments(description: str) -> argparse.Namespace:
    """``--quick`` and ``--json FILE``."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="few repetitions: to see that it runs")
    parser.add_argument("--json", type=Path, help="write the measurements to this file")
    return parser.parse_args()


def machine() -> dict[str, Any]:
    """Processor, cores, load and versions: figures without these say little."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "load_1min": round(os.getloadavg()[0], 2),
        "device": jax.devices()[0].device_kind,
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("contactgraph", "jax", "jaxlib", "equinox", "numpy")},
    }


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


class Compilations:
    """Counts XLA compilations by JAX's events, for the lifetime of the process."""

    def __init__(self) -> None:
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, event: str, seconds: float, **_: Any) -> None:
        self.count += event == "/jax/core/compile/backend_compile_duration"


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of equal keys as aligned text."""
    heads = list(rows[0])
    cells = [heads, *[[_text(row[head]) for head in heads] for row in rows]]
    widths = [max(len(row[column]) for row in cells) for column in range(len(heads))]
    lines = ["  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in cells]
    return "\n".join([lines[0], "  ".join("-" * width for width in widths), *lines[1:]])


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.2f}" if abs(value) < 100 else f"{value:,.0f}"


def report(name: str, rows: Sequence[Mapping[str, Any]], options: argparse.Namespace) -> None:
    """Print the machine and the table; write both as JSON where a file was named."""
    about = machine()
    print(
        f"{about['processor']}, {about['cores']} cores, load {about['load_1min']}, "
        f"jax {about['jax']} on {about['device']}, Python {about['python']}"
    )
    print(table(rows))
    if options.json is not None:
        content = {"benchmark": name, "quick": options.quick, "machine": about, "rows": list(rows)}
        options.json.write_text(json.dumps(content, indent=2) + "\n")


@dataclass(frozen=True)
class Method:
    """A method to compare."""

    name: str
    run: Callable[[], Any]
    """Returns once the answer exists."""
    answer: Callable[[Any], Any] = np.asarray
    """Arrays comparable with those of other methods, from the value that `run` returned."""


@dataclass(frozen=True)
class Missing:
    """A peer that is not installed."""

    name: str
    reason: str


def compare(what: str, ours: Method, peers: Sequence[Method | Missing], quick: bool) -> list[Row]:
    """One row for each peer. The methods take turns, so that other load meets all of them."""
    present = [peer for peer in peers if isinstance(peer, Method)]
    methods = [ours, *present]
    answers = [method.answer(method.run()) for method in methods]  # compiles, too
    seconds: list[list[float]] = [[] for _ in methods]
    until = time.perf_counter() + (QUICK_S if quick else FULL_S)
    while not seconds[0] or (time.perf_counter() < until and len(seconds[0]) < MAX_ROUNDS):
        for method, times in zip(methods, seconds, strict=True):
            times.append(timed(method.run))
    rows = [
        comparison(what, seconds[0], peer.name, times, difference(answer, answers[0]))
        for peer, times, answer in zip(present, seconds[1:], answers[1:], strict=True)
    ]
    for peer in peers:
        if isinstance(peer, Missing):
            print(f"{what}: {peer.name} is left out: {peer.reason}")
            rows.append(comparison(what, seconds[0], f"{peer.name}: {peer.reason}"))
    return rows


def timed(run: Callable[[], Any]) -> float:
    """Wall time of a call, s."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def medians(calls: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Milliseconds of each call, by name, after one that compiles; the calls take turns."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        jax.block_until_ready(call())
    for _ in range(rounds):
        for name, call in calls.items():
            times[name].append(timed(lambda call=call: jax.block_until_ready(call())))
    return {name: 1e3 * float(np.median(taken)) for name, taken in times.items()}


def comparison(
    what: str,
    ours: Sequence[float],
    peer: str,
    theirs: Sequence[float] | None = None,
    agreement: float | None = None,
) -> Row:
    """A row of interleaved times, s."""
    return {
        "what": what,
        "ours ms": 1e3 * float(np.median(ours)),
        "peer": peer,
        "peer ms": None if theirs is None else 1e3 * float(np.median(theirs)),
        "ratio": None if theirs is None else float(np.median(np.divide(theirs, ours))),
        "agreement": "" if agreement is None else f"{agreement:.0e}",
        "rounds": len(ours),
    }


def difference(answer: Any, reference: Any) -> float:
    """The largest over all arrays, as a fraction of the reference's largest entry."""

    def apart(ours: np.ndarray, theirs: np.ndarray) -> float:
        gap = np.abs(np.asarray(ours, np.float64) - theirs)
        return float(np.max(gap) / (np.max(np.abs(theirs)) or 1.0))

    return max(jax.tree.leaves(jax.tree.map(apart, answer, reference)))
