"""Work shared out to processes, whose answers come back in order."""

import multiprocessing
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from contactgraph.data import InvalidInputError

Answer = TypeVar("Answer")
Work = Callable[[int], Answer]


def shared_out(
    begin: Callable[[], Work[Answer]], indices: Sequence[int], processes: int
) -> Iterator[Answer]:
    """What the work answers to each of the ``indices``, in their order.

    Every one of the ``processes`` calls ``begin`` once, for the work it then does. ``begin`` and
    the answers are sent from process to process: they are made of plain values, and of functions
    and classes that a module has at its top. A script in which this is called is imported by every
    process, so what it does must be under ``if __name__ == "__main__"``.

    Processes are new ones, not copies of this one. They end with the iterator, with Ctrl-C and
    with this process, whatever they are at.

    Raises `InvalidInputError` as the work does, and `RuntimeError` with the traceback of whatever
    else the work raises, or where a process dies.
    """
    workers: dict[Connection, BaseProcess] = {}
    try:
        for _ in range(processes):
            connection, process = _started()
            workers[connection] = process
        # Not with the start: should a process die there, that would wait for ever to be read.
        for connection, process in workers.items():
            with _death_told(process):
                connection.send(begin)
        yield from _answers(workers, indices)
    finally:
        for connection, process in workers.items():
            process.kill()
            process.join()
            connection.close()


def _answers(workers: dict[Connection, BaseProcess], indices: Sequence[int]) -> Iterator[Any]:
    idle, waiting = list(workers), list(reversed(indices))
    done: dict[int, Any] = {}
    for index in indices:
        while index not in done:
            while idle and waiting:
                connection = idle.pop()
                with _death_told(workers[connection]):
                    connection.send(waiting.pop())
            for ready in wait(list(workers)):
                assert isinstance(ready, Connection)
                with _death_told(workers[ready]):
                    at, answer = ready.recv()
                if isinstance(answer, _Mistake):
                    raise InvalidInputError(answer.text)
                if isinstance(answer, _Fault):
                    raise RuntimeError(answer.text)
                done[at] = answer
                idle.append(ready)
        yield done.pop(index)


@dataclass(frozen=True)
class _Mistake:
    """`InvalidInputError` in a process."""

    text: str


@dataclass(frozen=True)
class _Fault:
    """Any other exception: its traceback."""

    text: str


def _serve(connection: Connection) -> None:
    """What a process does: answer, until its owner asks no more, or is gone."""
    work: Work[Any] | None = None
    with suppress(EOFError, ConnectionError):
        begin = connection.recv()
        while True:
            index = connection.recv()
            answer: Any
            try:
                work = work or begin()
                answer = work(index)
            except InvalidInputError as mistake:
                answer = _Mistake(str(mistake))
            except Exception:
                answer = _Fault(traceback.format_exc())
            connection.send((index, answer))


def _started() -> tuple[Connection, BaseProcess]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs,), daemon=True)
    with _interrupts_held():
        process.start()
    theirs.close()
    return ours, process


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
def _death_told(process: BaseProcess) -> Iterator[None]:
    try:
        yield
    except (EOFError, ConnectionError) as lost:
        process.join(timeout=1.0)
        raise RuntimeError(
            f"a process that shared the work has died, exit code {process.exitcode}"
        ) from lost
