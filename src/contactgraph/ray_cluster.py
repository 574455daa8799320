"""The executor for several machines: Ray, which places items and repeats those of lost machines."""

import logging
import os
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import version
from typing import Any

from contactgraph.data import InvalidInputError
from contactgraph.parallel import Initializer, Outcome, Pool, Work

try:
    import ray
except ImportError as error:
    raise InvalidInputError(
        "a cluster needs Ray: pip install 'contactgraph[cluster]', here and on its machines"
    ) from error

_TRIES = 4
"""Attempts at an item whose process or machine dies, before it is reported as lost."""
_AHEAD = 2
"""Items submitted for each core of the cluster, so that no core waits for its next item."""
_CORES_KNOWN_S = 1.0
"""Age of the known number of cores after which it is updated."""

_ANSWER_S = 5.0
_SETTINGS = bytes(3) + b"\x04" + bytes(5)
_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + _SETTINGS
"""The beginning of HTTP/2, which Ray's servers speak; they answer with settings of their own."""


class RayExecutor:
    """The machines of a Ray cluster, one item a core at a time. See `connected`.

    They share no files with this machine. They need the same version of Python, and of this
    package, which is checked.
    """

    shares_files = False

    @property
    def workers(self) -> int:
        """The cores of the machines that are in the cluster now."""
        return max(1, int(ray.cluster_resources().get("CPU", 0)))

    @contextmanager
    def pool(self, initializer: Initializer, items: int) -> Iterator[Pool]:
        """See `Executor`; machines may join and leave the cluster meanwhile."""
        pool = _RayPool(self, initializer)
        try:
            yield pool
        finally:
            pool.end()


@contextmanager
def connected(address: str | None = None) -> Iterator[RayExecutor]:
    """The cluster at ``HOST:PORT``, which this machine belongs to.

    Without an address: the cluster of RAY_ADDRESS, or the one that this machine belongs to, or a
    new one of this machine alone, which ends with the context. Raises `InvalidInputError` if no
    usable cluster answers.
    """
    if address is not None:
        _check_answers(address)
    # No usage reports, and no warning about a default that the user cannot change.
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
    # Ray itself would wait for a quarter of an hour at a silent port.
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


class _RayPool:
    """Items submitted to the cluster. Ray chooses workers, so numbers stand for items in work."""

    def __init__(self, cluster: RayExecutor, initializer: Initializer) -> None:
        self._cluster = cluster
        self._initializer = ray.put(initializer)
        self._process = ray.remote(num_cpus=1, max_retries=_TRIES - 1)(_process)
        self._submitted: dict[Any, tuple[int, Any]] = {}
        self._size, self._updated_s = 0, -_CORES_KNOWN_S

    def idle(self) -> Sequence[int]:
        if time.monotonic() - self._updated_s >= _CORES_KNOWN_S:
            self._size, self._updated_s = _AHEAD * self._cluster.workers, time.monotonic()
        busy = {worker for worker, _ in self._submitted.values()}
        return [worker for worker in range(self._size) if worker not in busy]

    def submit(self, worker: int, item: Any) -> None:
        # Ray would replace a bare reference by its value.
        reference = self._process.remote([self._initializer], version("contactgraph"), item)
        self._submitted[reference] = worker, item

    def wait(self) -> Sequence[Outcome]:
        submitted = list(self._submitted)
        ray.wait(submitted, num_returns=1)
        ready = ray.wait(submitted, num_returns=len(submitted), timeout=0)[0]
        return [self._outcome(reference) for reference in ready]

    def end(self) -> None:
        for reference in self._submitted:
            ray.cancel(reference, force=True)

    def _outcome(self, reference: Any) -> Outcome:
        worker, item = self._submitted.pop(reference)
        try:
            return Outcome(worker, item, ray.get(reference))
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, InvalidInputError):
                raise error.cause from None
            raise RuntimeError(str(error)) from None
        except ray.exceptions.RayError as error:
            return Outcome(worker, item, lost=f"begun {_TRIES} times: {_first_line(error)}")


def _process(initializer: list[Any], required: str, item: Any) -> Any:
    """Runs on a machine of the cluster."""
    os.environ["NPROC"] = "1"  # XLA follows it, too
    return _work(initializer[0], required)(item)


@lru_cache(maxsize=1)
def _work(initializer: Any, required: str) -> Work:
    """The work of this process, initialized once."""
    installed, host = version("contactgraph"), socket.gethostname()
    if installed != required:
        raise InvalidInputError(
            f"{host} has contactgraph {installed}, not {required} as here: all machines "
            "of a cluster need the same"
        )
    work: Work = ray.get(initializer)()
    return work


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[0] or type(error).__name__
