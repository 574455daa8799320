"""AsyncPlanner in a process of its own."""

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

_MOST_UNREAD = 20
"""Moments that may wait to be planned from: they are far from filling the connection, so that to
offer one never waits. A planner that leaves more unread is stopped by the age of its plan."""


class PlannerProcess:
    """A `AsyncPlanner` whose planner cannot disturb the loop's process, and need not be quick.

    A thread would: while it runs Python, or is itself kept waiting for a core in the midst of it,
    the loop waits. Measured on a busy machine, with a loop of real-time priority: beside a planner
    of plain Python in a thread, 99 % of ticks came within 2.7 ms and eight a second later than 3
    ms; by itself, 99 % within 0.12 ms and one a second, when the machine itself stood still.

    ``with PlannerProcess(make) as planning`` serves one run after another. Ends with its context
    and with the process that made it.
    """

    def __init__(self, make_planner: Callable[[], Planner]) -> None:
        """``make_planner`` is sent to the process: a function or class of a module, or a partial.

        Raises what it raises, if that is `InvalidInputError`.
        """
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, make_planner), daemon=True, name="planning"
        )
        self._process.start()
        theirs.close()
        self._unread = 0
        try:
            self.interval: float = self._answer()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "PlannerProcess":
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the process, whatever it is at."""
        self._process.kill()
        self._process.join()
        self._connection.close()

    def begin(self, start: EpisodeStart) -> None:
        """See `AsyncPlanner`."""
        self._unread = 0
        with suppress(ConnectionError):  # that it is gone is found by who waits for the answer
            self._connection.send(start)
        # What an earlier run left to be planned from comes first.
        while self._answer() is not None:
            pass

    def submit(self, moment: TimedObservation) -> None:
        """See `AsyncPlanner`."""
        if self._unread < _MOST_UNREAD:
            self._unread += 1
            with suppress(ConnectionError):
                self._connection.send(moment)

    def poll(self) -> PlanResult | None:
        """See `AsyncPlanner`."""
        if not self._connection.poll():
            return None
        read, planned = self._answer()
        self._unread -= read
        return planned

    def _answer(self) -> Any:
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
    """The planner's process: reads `EpisodeStart`s and `TimedObservation`s, and answers."""
    # Ctrl-C is for the loop, which ends its run gently, and then this.
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
            connection.send(RuntimeError("the planner broke down:\n" + traceback.format_exc()))


def _plan(planner: Planner, connection: Connection) -> None:
    """One answer to all that has come."""
    told = [connection.recv()]
    began = time.perf_counter()
    while connection.poll():
        told.append(connection.recv())
    starts = [index for index, each in enumerate(told) if isinstance(each, EpisodeStart)]
    if starts:
        planner.begin(told[starts[-1]])
        connection.send(None)
        told = told[starts[-1] + 1 :]
        began = time.perf_counter()
    if told:
        law = planner.plan(told)
        took = time.perf_counter() - began
        connection.send((len(told), PlanResult(law, told[-1].time, took)))
