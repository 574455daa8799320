"""Parallel work: the protocol of an executor, and the executor of this machine.

`Executor` and `Pool` follow `concurrent.futures`, with two differences: the caller chooses the
worker of an item, since a worker keeps the programs that it has compiled, and a worker that dies
costs its own item only. `contactgraph.ray_cluster` has the executor for several machines.
"""

import itertools
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Generator, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Protocol, TypeVar

from contactgraph.data import InvalidInputError

Item = TypeVar("Item", bound=Hashable)
Result = TypeVar("Result")
Work = Callable[[Any], Any]
Initializer = Callable[[], Work]
"""Called once by each worker; returns the function that the worker applies to its items."""


@dataclass(frozen=True)
class Outcome:
    """The end of one item's work."""

    worker: int
    item: Any
    result: Any = None
    lost: str | None = None
    """The reason, in one line, if the worker ended before it had a result."""


class Pool(Protocol):
    """Workers that share one initializer."""

    def idle(self) -> Sequence[int]:
        """The workers without an item, by numbers that stand for them as long as they live."""

    def submit(self, worker: int, item: Any) -> None:
        """Gives an item to an idle worker."""

    def wait(self) -> Sequence[Outcome]:
        """Waits for at least one outcome; returns all since the last call.

        Raises `InvalidInputError` if the work does, and `RuntimeError` with the traceback of any
        other exception of the work.
        """


class Executor(Protocol):
    """A source of worker pools."""

    @property
    def workers(self) -> int:
        """Items that are processed at a time; may change."""

    @property
    def shares_files(self) -> bool:
        """Whether workers see the same files as this process."""

    def pool(self, initializer: Initializer, items: int) -> AbstractContextManager[Pool]:
        """Workers for at most ``items`` items; all end with the context.

        ``initializer``, items and results are pickled, so functions and classes must be at the
        top level of a module.
        """


def map_in_order(
    executor: Executor, initializer: Callable[[], Callable[[Item], Result]], items: Sequence[Item]
) -> Generator[Result, None, None]:
    """The results of all items, in the order of the items. Workers end with the iterator.

    Raises as `Pool.wait` does, and `RuntimeError` if a worker is lost.
    """
    waiting = list(reversed(items))
    results: dict[Item, Result] = {}
    with executor.pool(initializer, len(items)) as pool:
        for item in items:
            while item not in results:
                for worker in pool.idle()[: len(waiting)]:
                    pool.submit(worker, waiting.pop())
                for outcome in pool.wait():
                    if outcome.lost is not None:
                        raise RuntimeError(f"{outcome.item}: {outcome.lost}")
                    results[outcome.item] = outcome.result
            yield results.pop(item)


_ALONE_S = 1.0
"""Time, s, for which one process always works, to measure the duration of an item."""
_START_S = 1.0
"""Measured time to start the workers."""


def map_if_faster(
    executor: Executor | None, initializer: Callable[[], Callable[[int], Result]], items: range
) -> Generator[Result, None, None]:
    """As `map_in_order`, by this process alone where workers would save no time."""
    work, began = initializer(), time.perf_counter()
    for done, item in enumerate(items):
        spent, left = time.perf_counter() - began, len(items) - done
        if done and executor is not None and spent > _ALONE_S:
            alone = spent / done * left
            if alone * (1.0 - 1.0 / executor.workers) > _START_S:
                yield from map_in_order(executor, initializer, items[done:])
                return
        yield work(item)


def usable_cores() -> list[int]:
    """The cores that this process may use, at most as many as NPROC says, if it is set."""
    if hasattr(os, "sched_getaffinity"):
        cores = sorted(os.sched_getaffinity(0))
    else:
        cores = list(range(os.cpu_count() or 1))
    limit = os.environ.get("NPROC", "")
    return cores[: max(1, int(limit))] if limit.isdecimal() else cores


class LocalExecutor:
    """Processes of this machine, by default one for each core.

    Each stays on its core where the system supports it. With ``whole_machine``, there is one
    process at a time, a new one for each item, with all cores; it may start processes of its own,
    as a simulated arm does with its camera and its controller.

    Every process imports the main script, so its work must be under ``if __name__ == "__main__"``.
    Processes end with their pool, with Ctrl-C and with this process, even while they work. Raises
    `InvalidInputError` if ``processes`` is less than 1.
    """

    shares_files = True

    def __init__(self, processes: int | None = None, *, whole_machine: bool = False) -> None:
        if processes is not None and processes < 1:
            raise InvalidInputError(f"processes must be at least 1, found {processes}")
        self._whole_machine = whole_machine
        self.workers = 1 if whole_machine else processes or len(usable_cores())

    @contextmanager
    def pool(self, initializer: Initializer, items: int) -> Iterator[Pool]:
        """See `Executor`."""
        cores = itertools.cycle([None] if self._whole_machine else usable_cores())
        pool = _LocalPool(initializer)
        try:
            pool.start(list(itertools.islice(cores, min(self.workers, items))))
            yield pool
        finally:
            pool.end()


class _LocalPool:
    def __init__(self, initializer: Initializer) -> None:
        self._initializer = initializer
        self._numbers = itertools.count()
        self._workers: dict[int, _Worker] = {}
        self._items: dict[int, Any] = {}
        """The items that workers are processing."""

    def start(self, cores: Sequence[int | None]) -> None:
        for core in cores:
            self._add(core).start()
        # Sending at the start could wait forever for a process that dies there.
        for worker in self._workers.values():
            worker.send(self._initializer)

    def idle(self) -> Sequence[int]:
        return [number for number in self._workers if number not in self._items]

    def submit(self, worker: int, item: Any) -> None:
        process = self._workers[worker]
        if process.connection is None:
            process.start()
            process.send(self._initializer)
        process.send(item)
        self._items[worker] = item

    def wait(self) -> Sequence[Outcome]:
        numbers: dict[Any, int] = {self._workers[one].connection: one for one in self._items}
        return [self._outcome(numbers[ready]) for ready in wait(list(numbers))]

    def end(self) -> None:
        for worker in self._workers.values():
            worker.end()

    def _outcome(self, number: int) -> Outcome:
        item, worker = self._items.pop(number), self._workers[number]
        assert worker.connection is not None
        try:
            outcome = Outcome(number, item, worker.connection.recv())
        except (EOFError, ConnectionError):
            died = f"its process died, exit code {worker.exit_code()}"
            outcome = Outcome(number, item, lost=died)
        if isinstance(outcome.result, Exception):
            raise outcome.result
        if outcome.lost is not None or worker.core is None:
            self._workers.pop(number).end()
            self._add(worker.core)
        return outcome

    def _add(self, core: int | None) -> "_Worker":
        worker = self._workers[next(self._numbers)] = _Worker(core)
        return worker


class _Worker:
    """A process that can be started, with a connection to it. Core None: all cores."""

    def __init__(self, core: int | None) -> None:
        self.core = core
        self.connection: Connection | None = None
        self._process: BaseProcess | None = None

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")
        connection, theirs = context.Pipe()
        pinned = self.core is not None
        # Processes that are daemons must not start processes.
        process = context.Process(target=_serve, args=(theirs, pinned), daemon=pinned)
        with nullcontext() if self.core is None else _pinned_start(self.core):
            process.start()
        theirs.close()
        self.connection, self._process = connection, process

    def send(self, value: Any) -> None:
        assert self.connection is not None
        with suppress(ConnectionError):  # `_LocalPool.wait` finds that the process has died
            self.connection.send(value)

    def exit_code(self) -> int | None:
        assert self._process is not None
        self._process.join(timeout=1.0)
        return self._process.exitcode

    def end(self) -> None:
        if self.connection is None or self._process is None:
            return
        self.connection.close()
        if self.core is None:
            self._process.join(timeout=5.0)  # so that the processes that it started can end
            self._process.terminate()
        else:
            self._process.kill()
        self._process.join()


def _serve(connection: Connection, pinned: bool) -> None:
    """The main loop of a worker process; it ends with its owner."""
    if pinned:
        os.environ["NPROC"] = "1"  # XLA follows it, too
    threading.Thread(target=_end_with_owner, daemon=True).start()
    with suppress(EOFError, ConnectionError):
        initializer = cache(connection.recv())
        while True:
            item = connection.recv()
            try:
                result = initializer()(item)
            except InvalidInputError as error:
                result = error
            except Exception:
                result = RuntimeError(traceback.format_exc())
            connection.send(result)


def _end_with_owner() -> None:
    if owner := multiprocessing.parent_process():
        owner.join()
        os._exit(1)


@contextmanager
def _pinned_start(core: int) -> Iterator[None]:
    """Processes that start in this context stay on the core, and never receive Ctrl-C.

    JAX starts as many threads as it sees cores; this process handles Ctrl-C.
    """
    with ExitStack() as restored:
        if hasattr(signal, "pthread_sigmask"):
            # The tracker starts with the first process and would unblock interrupts for the others.
            resource_tracker.ensure_running()
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            restored.callback(signal.pthread_sigmask, signal.SIG_SETMASK, mask)
        if hasattr(os, "sched_setaffinity"):
            restored.callback(os.sched_setaffinity, 0, os.sched_getaffinity(0))
            os.sched_setaffinity(0, {core})
        yield
