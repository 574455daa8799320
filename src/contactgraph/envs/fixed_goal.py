"""What all episodes of a task may share: the targets and the goal of one scene."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from contactgraph.data import InvalidInputError

Layout = TypeVar("Layout")


def fixed_layout(
    fixed_seed: int | None, sample: Callable[[np.random.Generator], Layout]
) -> Layout | None:
    """The layout whose targets and goal all episodes share; None: each episode has its own.

    ``sample`` should place as many distractors as there can ever be: then the targets and the
    goal leave room for any number of them, and do not depend on it. Raises `InvalidInputError`
    where the seed is negative.
    """
    if fixed_seed is None:
        return None
    if fixed_seed < 0:
        raise InvalidInputError(f"fixed_seed must be at least 0, found {fixed_seed}")
    return sample(np.random.default_rng(fixed_seed))


def fixed_metadata(fixed_seed: int | None) -> dict[str, int]:
    """What a scene tells of it, beside its own seed, so that it can be had again."""
    return {} if fixed_seed is None else {"fixed_seed": fixed_seed}
