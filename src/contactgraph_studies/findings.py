"""What a study says, and what a study is to whoever makes its cells."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from contactgraph.viz import Number
from contactgraph_studies.cell import Cell
from contactgraph_studies.claim import Claim
from contactgraph_studies.page_table import PageTable


@dataclass(frozen=True)
class Picture:
    """A figure of the page."""

    title: str
    caption: str
    image: bytes
    kind: str
    """``svg+xml`` or ``png``."""


@dataclass(frozen=True)
class Findings:
    """All that a study says."""

    title: str
    summary: str
    claims: Sequence[Claim]
    asked: str
    """The heading of the targets."""
    targets: Sequence[Number]
    tables: Sequence[PageTable]
    """The main one first."""
    table_markdown: str
    """The main one, for people …"""
    table_csv: str
    """… and for programs."""
    figures: Sequence[Picture]
    scenes: Sequence[Picture]
    amounts: Mapping[str, Any]
    """How much was measured; JSON."""
    readings: Sequence[Mapping[str, Any]]
    """Every number of every cell, so that the cells' own folders need not be kept; JSON."""


class StudyPlan(Protocol):
    """What is to be made, and what it says once it is there."""

    @property
    def cells(self) -> Sequence[Cell]:
        """All that is made, in order of need."""

    def findings(self, folder: Path) -> Findings:
        """From the cells that are there in the folder; figures are written to it."""
