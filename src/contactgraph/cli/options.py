"""Strings are looked up in the tables of the commands, and nowhere else."""

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TypeVar

from contactgraph.data import InvalidInputError
from contactgraph.parallel import Executor, LocalExecutor

Value = TypeVar("Value")


def choice(what: str, name: str, table: dict[str, Value]) -> Value:
    """The table's entry; where there is none, an error that lists those there are."""
    if name not in table:
        raise InvalidInputError(f"{what} must be one of {', '.join(table)}; found {name!r}")
    return table[name]


_LARGEST_SEED = 2**32 - 1
"""Random keys are made of 32 bits: a larger seed would be another one in disguise."""


def check_range(flag: str, value: int, lowest: int, highest: int) -> None:
    """Raises `InvalidInputError` where the flag's value is outside ``lowest … highest``."""
    if not lowest <= value <= highest:
        raise InvalidInputError(f"{flag} must be {lowest} to {highest}, found {value}")


def check_seed(seed: int) -> None:
    """Raises `InvalidInputError` for a seed that random numbers cannot be made from."""
    check_range("--seed", seed, 0, _LARGEST_SEED)


def check_weight(flag: str, weight: float) -> None:
    """Raises `InvalidInputError` for what cannot weigh anything."""
    if not (weight >= 0 and math.isfinite(weight)):
        raise InvalidInputError(f"{flag} must be a number of at least 0, found {weight}")


def check_share(flag: str, share: float) -> None:
    """Raises `InvalidInputError` for what is no part of a whole."""
    if not 0.0 <= share <= 1.0:
        raise InvalidInputError(f"{flag} must be 0 to 1, found {share}")


def check_episodes(episodes: int) -> None:
    """Raises `InvalidInputError` for no episodes, or more than memory could hold."""
    check_range("--episodes", episodes, 1, 100_000)


@contextmanager
def open_executor(cluster: str) -> Iterator[Executor]:
    """What ``--cluster`` names: ``local``, ``ray`` or ``ray:HOST:PORT``."""
    name, colon, address = cluster.partition(":")
    opened = choice("--cluster", name, _ENGINES)
    with opened(address if colon else None) as engine:
        yield engine


def _local(address: str | None) -> AbstractContextManager[Executor]:
    if address is not None:
        raise InvalidInputError(f"--cluster: local takes no address, found {address!r}")
    return nullcontext(LocalExecutor())


def _ray(address: str | None) -> AbstractContextManager[Executor]:
    from contactgraph.ray_cluster import connected

    return connected(address)


_ENGINES: dict[str, Callable[[str | None], AbstractContextManager[Executor]]] = {
    "local": _local,
    "ray": _ray,
}
