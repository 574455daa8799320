"""A cell of a study: one command line of ours, and the file that it makes."""

import hashlib
import json
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class Cell:
    """Paths are relative to the study's folder, in which the command is run."""

    output: str
    """The file, or the folder, that is there once the command is done."""
    arguments: tuple[str, ...]
    """What follows ``contactgraph`` on the command line."""
    kind: str
    """Cells of one kind take about as long as each other, and need the same compiled programs."""
    needs: tuple["Cell", ...] = ()
    """Cells whose outputs it reads."""
    beside: tuple[str, ...] = ()
    """Other files that the command leaves and cells that need it read."""
    checkpoints: str = ""
    """Files in the output, as a glob pattern, from which ``--resume`` goes on; "": it cannot."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """All that it leaves."""
        return (self.output, *self.beside)

    @property
    def command(self) -> str:
        """As a user would type it."""
        return f"contactgraph {shlex.join(self.arguments)}"

    @cached_property
    def fingerprint(self) -> str:
        """Of the command and of all that its inputs are made by: another one, another result."""
        parts = [list(self.arguments), [cell.fingerprint for cell in self.needs]]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


def in_order(wanted: Iterable[Cell]) -> list[Cell]:
    """The cells and all that they need, each once, behind what it needs.

    Otherwise in the order asked for, so that a result's own inputs are made just before it.
    """
    # By output: comparing whole cells would compare all their inputs, over and over.
    found: dict[str, Cell] = {}

    def add(cell: Cell) -> None:
        if cell.output in found:
            return
        for needed in cell.needs:
            add(needed)
        found[cell.output] = cell

    for cell in wanted:
        add(cell)
    return list(found.values())
