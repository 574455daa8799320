"""A planner in a process of its own."""

import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection

from contactgraph_franka.loop.planner import EpisodeStart, Planner, PlanResult, TimedObservation
from contactgraph_franka.loop.worker_process import WorkerProcess

_MAX_UNREAD = 20
"""Observations that may wait for the planner: few enough for the connection, so that `submit` never
blocks. A planner that leaves more unread is stopped by the age of its plan."""


class PlannerProcess:
    """An `AsyncPlanner` whose planner cannot delay the loop's process, however long it takes.

    ``with PlannerProcess(make_planner) as planner`` serves one episode after another. The process
    ends with the context and with the process that started it.
    """

    def __init__(self, make_planner: Callable[[], Planner]) -> None:
        """``make_planner`` is sent to the process: a function or class of a module, or a partial.

        Raises its error, if that is `InvalidInputError`.
        """
        self._worker = WorkerProcess("the planner's process", _serve, make_planner)
        self._unread = 0
        try:
            self.interval: float = self._worker.receive()
        except BaseException:
            self._worker.close()
            raise

    def __enter__(self) -> "PlannerProcess":
        return self

    def __exit__(self, *raised: object) -> None:
        self._worker.close()

    def reset(self, start: EpisodeStart) -> None:
        """See `AsyncPlanner`."""
        self._unread = 0
        with suppress(ConnectionError):  # `receive` reports a process that has ended
            self._worker.connection.send(start)
        # Plans of the previous episode arrive first.
        while self._worker.receive() is not None:
            pass

    def submit(self, observation: TimedObservation) -> None:
        """See `AsyncPlanner`."""
        if self._unread < _MAX_UNREAD:
            self._unread += 1
            with suppress(ConnectionError):
                self._worker.connection.send(observation)

    def poll(self) -> PlanResult | None:
        """See `AsyncPlanner`."""
        if not self._worker.connection.poll():
            return None
        read, result = self._worker.receive()
        self._unread -= read
        return result


def _serve(connection: Connection, make_planner: Callable[[], Planner]) -> None:
    planner = make_planner()
    connection.send(planner.interval)
    while True:
        _plan(planner, connection)


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
