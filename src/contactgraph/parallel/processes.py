"""The engine of this machine: processes, each on a core of its own."""

import itertools
import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from contactgraph.data import InvalidInputError
from contactgraph.parallel.attempt import attempt, told
from contactgraph.parallel.engine import Begin, Crew, Outcome


def usable_cores() -> list[int]:
    """The cores that this process may use; as many as NPROC says, where it is set."""
    if hasattr(os, "sched_getaffinity"):
        cores = sorted(os.sched_getaffinity(0))
    else:
        cores = list(range(os.cpu_count() or 1))
    most = os.environ.get("NPROC", "")
    return cores[: max(1, int(most))] if most.isdecimal() else cores


def keep_to_one_core() -> None:
    """Said to whatever this process does from now on; XLA, too, goes by NPROC."""
    os.environ["NPROC"] = "1"


class LocalProcesses:
    """New processes of this machine, as many as there are cores if not told otherwise.

    Each stays on one core, where the system lets it. A script in which they are used is imported
    by every process, so what it does must be under ``if __name__ == "__main__"``. They end with
    their context, with Ctrl-C and with this process, whatever they are at. Raises
    `InvalidInputError` where the number of processes is less than 1.
    """

    sees_files = True

    def __init__(self, processes: int | None = None) -> None:
        self.workers = len(usable_cores()) if processes is None else processes
        if self.workers < 1:
            raise InvalidInputError(f"processes must be at least 1, found {processes}")

    @contextmanager
    def crew(self, begin: Begin, units: int, units_a_worker: int = 0) -> Iterator[Crew]:
        """See `Engine`."""
        crew = _Processes(begin, units_a_worker)
        try:
            crew.start(min(self.workers, units))
            yield crew
        finally:
            crew.end()


class _Process:
    """A process and the connection to it; begun once, and not before it is needed."""

    def __init__(self, core: int) -> None:
        self.core, self.units = core, 0
        self._running: tuple[Connection, BaseProcess] | None = None

    @property
    def started(self) -> bool:
        return self._running is not None

    @property
    def connection(self) -> Connection:
        assert self._running is not None
        return self._running[0]

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with _interrupts_held(), _kept_to(self.core):
            process.start()
        theirs.close()
        self._running = ours, process

    def send(self, value: Any) -> None:
        with suppress(ConnectionError):  # that it is gone is found by who waits for it
            self.connection.send(value)

    def exit_code(self) -> int | None:
        assert self._running is not None
        self._running[1].join(timeout=1.0)
        return self._running[1].exitcode

    def end(self) -> None:
        if self._running is not None:
            connection, process = self._running
            process.kill()
            process.join()
            connection.close()


class _Processes:
    """Processes by their numbers."""

    def __init__(self, begin: Begin, units_a_worker: int) -> None:
        self._begin, self._units_a_worker = begin, units_a_worker
        self._numbers = itertools.count()
        self._processes: dict[int, _Process] = {}
        self._at: dict[int, Any] = {}
        """The units that processes are at."""

    def start(self, count: int) -> None:
        cores = usable_cores()
        for number in range(count):
            self._add(cores[number % len(cores)]).start()
        # Not with the start: should a process die there, that would wait for ever to be read.
        for process in self._processes.values():
            process.send(self._begin)

    def idle(self) -> Sequence[int]:
        return [number for number in self._processes if number not in self._at]

    def give(self, worker: int, unit: Any) -> None:
        process = self._processes[worker]
        if not process.started:
            process.start()
            process.send(self._begin)
        process.units += 1
        process.send(unit)
        self._at[worker] = unit

    def wait(self) -> Sequence[Outcome]:
        numbers: dict[Any, int] = {self._processes[one].connection: one for one in self._at}
        return [self._outcome(numbers[ready]) for ready in wait(list(numbers))]

    def end(self) -> None:
        for process in self._processes.values():
            process.end()

    def _outcome(self, number: int) -> Outcome:
        unit, process = self._at.pop(number), self._processes[number]
        try:
            outcome = Outcome(number, unit, told(process.connection.recv()))
        except (EOFError, ConnectionError):
            died = f"its process died, exit code {process.exit_code()}"
            outcome = Outcome(number, unit, lost=died)
        if outcome.lost is not None or process.units == self._units_a_worker:
            self._processes.pop(number).end()
            self._add(process.core)
        return outcome

    def _add(self, core: int) -> _Process:
        process = _Process(core)
        self._processes[next(self._numbers)] = process
        return process


def _serve(connection: Connection) -> None:
    """What a process does: answer, until its owner asks no more, or is gone."""
    keep_to_one_core()
    with suppress(EOFError, ConnectionError):
        begin = cache(connection.recv())
        while True:
            unit = connection.recv()
            connection.send(attempt(begin, unit))


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Processes begun in here never feel Ctrl-C, which is for this one to answer; it waits."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # It is started with the first process, and would let interrupts through from then on.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _kept_to(core: int) -> Iterator[None]:
    """Processes begun in here stay on the core: JAX makes as many threads as it sees cores."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
