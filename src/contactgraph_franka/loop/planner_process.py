"""A planner in a process of its own."""

import multiprocessing
import signal
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop.planner import EpisodeStart, Planner, PlanResult, TimedObservation
from contactgraph_franka.loop.realtime import set_nice

_MAX_UNREAD = 20
"""Observations that may wait for the planner: few enough for the connection, so that `submit` never
blocks. A planner that leaves more unread is stopped by the age of its plan."""


class PlannerProcess:
    """An `AsyncPlanner` whose planner cannot delay the loop's process, however long it takes.

    A thread would delay it whenever it runs Python, or waits for a core while it holds Python's
    lock. Measured on a busy machine with a loop of real-time priority: beside a planner of plain
    Python in a thread, 99 % of cycles began within 2.7 ms of their time and eight a second later
    than 3 ms; without it, 99 % within 0.12 ms and one a second, when the machine itself stalled.

    ``with PlannerProcess(make_planner) as planner`` serves one episode after another. The process
    ends with the context and with the process that started it.
    """

    def __init__(self, make_planner: Callable[[], Planner]) -> None:
        """``make_planner`` is sent to the process: a function or class of a module, or a partial.

        Raises its error, if that is `InvalidInputError`.
        """
        context = multiprocessing.get_context("spawn")
        self._connection, remote = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(remote, make_planner), daemon=True, name="planning"
        )
        self._process.start()
        remote.close()
        self._unread = 0
        try:
            self.interval: float = self._receive()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "PlannerProcess":
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the process at once."""
        self._process.kill()
        self._process.join()
        self._connection.close()

    def reset(self, start: EpisodeStart) -> None:
        """See `AsyncPlanner`."""
        self._unread = 0
        with suppress(ConnectionError):  # `_receive` reports a process that has ended
            self._connection.send(start)
        # Plans of the previous episode arrive first.
        while self._receive() is not None:
            pass

    def submit(self, observation: TimedObservation) -> None:
        """See `AsyncPlanner`."""
        if self._unread < _MAX_UNREAD:
            self._unread += 1
            with suppress(ConnectionError):
                self._connection.send(observation)

    def poll(self) -> PlanResult | None:
        """See `AsyncPlanner`."""
        if not self._connection.poll():
            return None
        read, result = self._receive()
        self._unread -= read
        return result

    def _receive(self) -> Any:
        try:
            answer = self._connection.recv()
        except (EOFError, ConnectionError) as error:
            self._process.join()
            raise RuntimeError(
                f"the planner's process ended with exit code {self._process.exitcode}"
            ) from error
        if isinstance(answer, BaseException):
            raise answer
        return answer


def _serve(connection: Connection, make_planner: Callable[[], Planner]) -> None:
    """Main function of the planner's process."""
    # Ctrl-C is for the loop, which ends its episode gently, and then this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_nice(0)
    with suppress(EOFError, ConnectionError):
        try:
            planner = make_planner()
            connection.send(planner.interval)
            while True:
                _plan(planner, connection)
        except InvalidInputError as error:
            connection.send(error)
        except (EOFError, ConnectionError):
            raise
        except Exception:
            connection.send(RuntimeError("the planner failed:\n" + traceback.format_exc()))


def _plan(planner: Planner, connection: Connection) -> None:
    """Makes one plan from all messages that have come."""
    messages = [connection.recv()]
    began = time.perf_counter()
    while connection.poll():
        messages.append(connection.recv())
    starts = [index for index, each in enumerate(messages) if isinstance(each, EpisodeStart)]
    if starts:
        planner.reset(messages[starts[-1]])
        connection.send(None)
        messages = messages[starts[-1] + 1 :]
        began = time.perf_counter()
    if messages:
        policy = planner.plan(messages)
        wall_s = time.perf_counter() - began
        connection.send((len(messages), PlanResult(policy, messages[-1].time, wall_s)))
