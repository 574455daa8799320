"""Numbers a user types, refused before any work is begun where nothing good can come of them."""

import math

from contactgraph.data import InvalidInputError

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
