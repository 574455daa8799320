"""The contract of an engine: units of work are handed out, and outcomes come back.

A unit is any plain value, and work answers it. An engine knows nothing of what units are about, and
decides nothing but which machine takes one; what is next, and what becomes of an answer, is for its
caller to say.
"""

import itertools
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Protocol, TypeVar

from contactgraph.data import InvalidInputError

Unit = TypeVar("Unit", bound=Hashable)
Answer = TypeVar("Answer")
Work = Callable[[Any], Any]
Begin = Callable[[], Work]
"""Called once by whoever does the work, for the work it then does."""


@dataclass(frozen=True)
class Outcome:
    """What became of a unit."""

    worker: int
    unit: Any
    answer: Any = None
    lost: str | None = None
    """Why there is no answer: whoever was at it is gone. One line."""


class Pool(Protocol):
    """Workers that wait for units of one kind of work."""

    def idle(self) -> Sequence[int]:
        """The workers that would take a unit now.

        A number stands for one worker for as long as it lives, and so for what it has learned
        (programs that it has compiled); an engine that cannot tell its workers apart numbers the
        places for them.
        """

    def give(self, worker: int, unit: Any) -> None:
        """Have an idle worker begin with a unit."""

    def wait(self) -> Sequence[Outcome]:
        """Outcomes since the last call, at least one; waits for it.

        Raises `InvalidInputError` as the work does, and `RuntimeError` with the traceback of
        whatever else the work raises.
        """


class Executor(Protocol):
    """Something that has workers."""

    @property
    def workers(self) -> int:
        """Units that are done at a time; may change."""

    @property
    def sees_files(self) -> bool:
        """Whether workers read and write the very files that are seen here."""

    def crew(
        self, begin: Begin, units: int, tasks_per_worker: int = 0
    ) -> AbstractContextManager[Pool]:
        """Workers for so many units at most. They end with the context, whatever they are at.

        ``begin``, units and answers are sent from one to the other: they are made of plain values,
        and of functions and classes that a module has at its top. A worker is replaced by another
        after ``tasks_per_worker`` units, if that is not 0: programs keep what they have compiled.
        """


def map_in_order(
    engine: Executor, begin: Callable[[], Callable[[Unit], Answer]], units: Sequence[Unit]
) -> Generator[Answer, None, None]:
    """What the work answers to each of the units, in their order. Workers end with the iterator.

    Raises as `Pool.wait` does, and `RuntimeError` where a worker is lost for good.
    """
    waiting = list(reversed(units))
    done: dict[Unit, Answer] = {}
    with engine.crew(begin, len(units)) as crew:
        for unit in units:
            while unit not in done:
                for worker in crew.idle()[: len(waiting)]:
                    crew.give(worker, waiting.pop())
                for outcome in crew.wait():
                    if outcome.lost is not None:
                        raise RuntimeError(f"{outcome.unit}: {outcome.lost}")
                    done[outcome.unit] = outcome.answer
            yield done.pop(unit)


@dataclass(frozen=True)
class _Mistake:
    """`InvalidInputError`."""

    text: str


@dataclass(frozen=True)
class _Fault:
    """Any other exception: its traceback."""

    text: str


def attempt(begin: Begin, unit: Any) -> Any:
    """What the work answers to the unit, or raises, as a value that can be sent."""
    try:
        return begin()(unit)
    except InvalidInputError as mistake:
        return _Mistake(str(mistake))
    except Exception:
        return _Fault(traceback.format_exc())


def told(answer: Any) -> Any:
    """What `attempt` has returned elsewhere.

    Raises `InvalidInputError` where the work did, and `RuntimeError` with the traceback of
    whatever else it raised.
    """
    if isinstance(answer, _Mistake):
        raise InvalidInputError(answer.text)
    if isinstance(answer, _Fault):
        raise RuntimeError(answer.text)
    return answer


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


class LocalExecutor:
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
    def crew(self, begin: Begin, units: int, tasks_per_worker: int = 0) -> Iterator[Pool]:
        """See `Executor`."""
        crew = _Processes(begin, tasks_per_worker)
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

    def __init__(self, begin: Begin, tasks_per_worker: int) -> None:
        self._begin, self._units_a_worker = begin, tasks_per_worker
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


class WholeMachineExecutor:
    """Every unit has a new process, with all cores; it may start processes of its own.

    For what must be on time, such as a simulated arm with its camera and a controller.
    """

    workers = 1
    sees_files = True

    @contextmanager
    def crew(self, begin: Begin, units: int, tasks_per_worker: int = 0) -> Iterator[Pool]:
        """See `Executor`."""
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
