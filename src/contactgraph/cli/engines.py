"""The engines by the names a user types."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from contactgraph.cli.names import looked_up
from contactgraph.data import InvalidInputError
from contactgraph.parallel import Engine, LocalProcesses


@contextmanager
def engine_of(cluster: str) -> Iterator[Engine]:
    """What ``--cluster`` names: ``local``, ``ray`` or ``ray:HOST:PORT``."""
    name, colon, address = cluster.partition(":")
    opened = looked_up("--cluster", name, _ENGINES)
    with opened(address if colon else None) as engine:
        yield engine


def _local(address: str | None) -> AbstractContextManager[Engine]:
    if address is not None:
        raise InvalidInputError(f"--cluster: local takes no address, found {address!r}")
    return nullcontext(LocalProcesses())


def _ray(address: str | None) -> AbstractContextManager[Engine]:
    from contactgraph.parallel.ray_cluster import connected

    return connected(address)


_ENGINES: dict[str, Callable[[str | None], AbstractContextManager[Engine]]] = {
    "local": _local,
    "ray": _ray,
}
