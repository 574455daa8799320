"""Ticks that come in time: all threads of the process on one core."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def on_one_core(core: int | None = None) -> Iterator[None]:
    """All threads of this process share a core within; None: the last that it may use.

    A tick is a chain of small operations, some of which XLA hands to threads of its own. On one
    core that is a switch; on several, the tick waits until another core is awake and free, now
    and then for many milliseconds. Compiling wants all cores, so `MPC.reset` comes before::

        state = mpc.reset(observation, nodes, cost)
        with on_one_core():
            while True:
                plan, state = mpc.step(observation, contacts, state)

    Threads begun within are there too, and free afterwards. Where the system does not let a
    process choose its cores (macOS, Windows), nothing is done. Raises `OSError` for a core that
    the process may not use.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    before = _places()
    os.sched_setaffinity(0, {max(allowed) if core is None else core})
    try:
        for thread in _places():
            _place(thread, os.sched_getaffinity(0))
        yield
    finally:
        for thread in _places():
            _place(thread, before.get(thread, allowed))


def _places() -> dict[int, set[int]]:
    """The cores that each thread of this process may use."""
    places = {}
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # It may have ended meanwhile.
            places[int(task.name)] = os.sched_getaffinity(int(task.name))
    return places


def _place(thread: int, cores: set[int]) -> None:
    with suppress(ProcessLookupError):
        os.sched_setaffinity(thread, cores)
