"""A cell whose output holds numbers, and what they are of."""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar

from contactgraph_studies.cell import Cell

Place = TypeVar("Place", bound=Hashable)
"""What a number is of: each study has words of its own."""


@dataclass(frozen=True)
class Measurement(Generic[Place]):
    """One cell whose output holds numbers."""

    where: Place
    seed: int
    """Of the data that was learned from."""
    cell: Cell
