"""The engine of work that needs all of a machine: one unit at a time, in a new process."""

import multiprocessing
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from contactgraph.parallel.attempt import attempt, told
from contactgraph.parallel.engine import Begin, Crew, Outcome


class WholeMachine:
    """Every unit has a new process, with all cores; it may start processes of its own.

    For what must be on time, such as a simulated arm with its camera and a controller.
    """

    workers = 1
    sees_files = True

    @contextmanager
    def crew(self, begin: Begin, units: int, units_a_worker: int = 0) -> Iterator[Crew]:
        """See `Engine`."""
        crew = _OneAtATime(begin)
        try:
            yield crew
        finally:
            crew.end()


class _OneAtATime:
    def __init__(self, begin: Begin) -> None:
        self._begin = begin
        self._number = 0
        self._running: tuple[BaseProcess, Connection, Any] | None = None

    def idle(self) -> Sequence[int]:
        return [self._number] if self._running is None else []

    def give(self, worker: int, unit: Any) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_do, args=(theirs, self._begin, unit))
        process.start()
        theirs.close()
        self._running = process, ours, unit

    def wait(self) -> Sequence[Outcome]:
        assert self._running is not None
        process, connection, unit = self._running
        worker = self._number
        try:
            outcome = Outcome(worker, unit, told(connection.recv()))
        except EOFError:
            process.join()
            died = f"its process died, exit code {process.exitcode}"
            outcome = Outcome(worker, unit, lost=died)
        self.end()
        return [outcome]

    def end(self) -> None:
        """What is running is asked to end, as by Ctrl-C, so that what it started ends with it."""
        if self._running is None:
            return
        process, connection, _ = self._running
        process.join(timeout=5.0)
        process.terminate()
        process.join()
        connection.close()
        self._running = None
        self._number += 1


def _do(connection: Connection, begin: Begin, unit: Any) -> None:
    threading.Thread(target=_end_with_owner, daemon=True).start()
    connection.send(attempt(begin, unit))


def _end_with_owner() -> None:
    """Daemons end with their owner by themselves, but may not start processes."""
    owner = multiprocessing.parent_process()
    if owner is not None:
        owner.join()
        os._exit(1)
