"""Processes beside a control loop: planning, perception, and the parts of a simulated robot.

A thread would delay the loop whenever it runs Python, or waits for a core while it holds Python's
lock. Measured on a busy machine with a loop of real-time priority: beside a planner of plain Python
in a thread, 99 % of cycles began within 2.7 ms of their time and eight a second later than 3 ms;
without it, 99 % within 0.12 ms and one a second, when the machine itself stalled.
"""

import multiprocessing
import signal
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop.realtime import set_nice


class WorkerProcess:
    """``work(connection, *arguments)`` in a process of its own.

    ``work`` is a function of a module; its arguments are pickled. It has normal priority, lowered
    by ``nice``, and ignores Ctrl-C, which is for the process that started it. The two ends of
    ``connection`` close with their processes, so that neither waits for a dead one.
    """

    def __init__(
        self, name: str, work: Callable[..., None], *arguments: object, nice: int = 0
    ) -> None:
        self._name = name
        context = multiprocessing.get_context("spawn")
        self.connection, remote = context.Pipe()
        self.process = context.Process(
            target=_serve, args=(remote, name, nice, work, arguments), daemon=True, name=name
        )
        self.process.start()
        remote.close()

    def receive(self, timeout: float | None = None) -> Any:
        """The next object that ``work`` sends.

        Raises its `InvalidInputError`, and a `RuntimeError` for any other end of it or where it
        sends nothing within ``timeout`` s.
        """
        try:
            if not self.connection.poll(timeout):
                raise RuntimeError(f"{self._name} was not ready within {timeout:g} s")
            answer = self.connection.recv()
        except (EOFError, OSError) as error:
            self.process.join()
            code = self.process.exitcode
            raise RuntimeError(f"{self._name} ended with exit code {code}") from error
        if isinstance(answer, Exception):
            raise answer
        return answer

    def check(self) -> None:
        """Raises the error that has ended a process which sends nothing else; see `receive`."""
        if self.connection.poll():
            self.receive()

    def close(self, patience: float = 0.0) -> None:
        """Ends the process: ``patience`` s after the end of its connection, by force."""
        self.connection.close()
        self.process.join(patience)
        self.process.kill()
        self.process.join()


def _serve(
    connection: Connection, name: str, nice: int, work: Callable[..., None], arguments: tuple
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_nice(nice)
    try:
        work(connection, *arguments)
        return
    except InvalidInputError as invalid:
        error: Exception = invalid
    except Exception:
        error = RuntimeError(f"{name} failed:\n{traceback.format_exc()}")
    with suppress(OSError):  # where the other process has ended
        connection.send(error)
