"""The engine of a cluster of machines: Ray, which decides where a unit is done, and does it again
where a machine is lost."""

import logging
import os
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from importlib.metadata import version
from typing import Any

from contactgraph.data import InvalidInputError
from contactgraph.parallel import Begin, Outcome, Pool, Work, attempt, keep_to_one_core, told

try:
    import ray
except ImportError as error:
    raise InvalidInputError(
        "a cluster needs Ray: pip install 'contactgraph[cluster]', here and on its machines"
    ) from error

_TRIES = 4
"""A unit whose process or machine dies is begun so many times before it is called lost."""
_AHEAD = 2
"""Units asked for, in cores of the cluster: who has done one finds another waiting."""
_CORES_KNOWN_S = 1.0
"""For so long the number of cores is not asked for anew."""

_ANSWER_S = 5.0
_SETTINGS = bytes(3) + b"\x04" + bytes(5)
_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + _SETTINGS
"""How HTTP/2 begins, on which Ray's servers speak; they answer with settings of their own."""


class RayExecutor:
    """The machines of a Ray cluster: one unit a core at a time. See `connected`.

    They read no files of this machine's. They need this package in the same version, which is
    checked, and Python in the same.
    """

    sees_files = False

    @property
    def workers(self) -> int:
        """The cores of the machines that are there now."""
        return max(1, int(ray.cluster_resources().get("CPU", 0)))

    @contextmanager
    def crew(self, begin: Begin, units: int, tasks_per_worker: int = 0) -> Iterator[Pool]:
        """See `Executor`; machines that come or go are made use of, or done without."""
        crew = _Places(self, begin, tasks_per_worker)
        try:
            yield crew
        finally:
            crew.end()


@contextmanager
def connected(address: str | None = None) -> Iterator[RayExecutor]:
    """The cluster at ``HOST:PORT``, of which this machine is one.

    Without an address: that of RAY_ADDRESS, or that which this machine is in, or else one of this
    machine alone, which ends with the context. Raises `InvalidInputError` where nothing answers at
    the address, or what answers cannot be worked with.
    """
    if address is not None:
        _check_answers(address)
    # Nobody is told that it is used, and what it warns of is not for the user to change.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        where = "Ray" if address is None else f"the Ray cluster at {address}"
        raise InvalidInputError(f"{where} cannot be used: {_first_line(error)}") from error
    try:
        yield RayExecutor()
    finally:
        ray.shutdown()


def _check_answers(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InvalidInputError(f"a cluster's address must be HOST:PORT, found {address!r}")
    # Asked first: Ray itself takes a quarter of an hour to give up on a silent port.
    try:
        with socket.create_connection((host, int(port)), timeout=_ANSWER_S) as server:
            server.sendall(_GREETING)
            answer = server.recv(len(_SETTINGS))
    except OSError as error:
        raise InvalidInputError(
            f"no Ray cluster answers at {address} ({error.strerror or error}); "
            "one is started with: ray start --head"
        ) from error
    if answer[3:4] != _SETTINGS[3:4]:
        raise InvalidInputError(f"what answers at {address} is no Ray cluster")


class _Places:
    """Units that the cluster was asked for, each in a place with a number."""

    def __init__(self, cluster: RayExecutor, begin: Begin, tasks_per_worker: int) -> None:
        self._cluster = cluster
        self._begin = ray.put(begin)
        self._perform = ray.remote(num_cpus=1, max_retries=_TRIES - 1, max_calls=tasks_per_worker)(
            _perform
        )
        self._at: dict[Any, tuple[int, Any]] = {}
        self._places, self._asked_s = 0, -_CORES_KNOWN_S

    def idle(self) -> Sequence[int]:
        if time.monotonic() - self._asked_s >= _CORES_KNOWN_S:
            self._places, self._asked_s = _AHEAD * self._cluster.workers, time.monotonic()
        taken = {place for place, _ in self._at.values()}
        return [place for place in range(self._places) if place not in taken]

    def give(self, worker: int, unit: Any) -> None:
        asked = self._perform.remote([self._begin], version("contactgraph"), unit)
        self._at[asked] = worker, unit

    def wait(self) -> Sequence[Outcome]:
        asked = list(self._at)
        ray.wait(asked, num_returns=1)
        return [self._outcome(one) for one in ray.wait(asked, num_returns=len(asked), timeout=0)[0]]

    def end(self) -> None:
        for asked in self._at:
            ray.cancel(asked, force=True)

    def _outcome(self, asked: Any) -> Outcome:
        worker, unit = self._at.pop(asked)
        try:
            return Outcome(worker, unit, told(ray.get(asked)))
        except ray.exceptions.RayTaskError as error:
            # The work's own errors are answers: this is of a machine that could not begin with it.
            raise InvalidInputError(
                f"a machine of the cluster cannot do the work: {_last_line(error)}; it needs what "
                "is installed here"
            ) from error
        except ray.exceptions.RayError as error:
            return Outcome(worker, unit, lost=f"begun {_TRIES} times: {_first_line(error)}")


def _perform(begin: list[Any], wanted: str, unit: Any) -> Any:
    """What a machine of the cluster does. ``begin`` is in a list, so that Ray leaves it alone."""
    keep_to_one_core()
    return attempt(partial(_begun, begin[0], wanted), unit)


@lru_cache(maxsize=1)
def _begun(begin: Any, wanted: str) -> Work:
    """The work of this process: it begins once."""
    found, host = version("contactgraph"), socket.gethostname()
    if found != wanted:
        raise InvalidInputError(
            f"{host} has contactgraph {found}, not {wanted} as here: all machines "
            "of a cluster need the same"
        )
    try:
        return ray.get(begin)()
    except ray.exceptions.RaySystemError as error:
        raise InvalidInputError(
            f"{host} cannot read the work it was sent ({_first_line(error)}); it needs what is "
            "installed here"
        ) from error


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[0] or type(error).__name__


def _last_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[-1]
