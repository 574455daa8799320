"""What must be true of the command lines of every study."""

from collections.abc import Iterable

from contactgraph.cli import main as cli
from contactgraph_studies.cell import Cell, in_order


def commands_of(cells: Iterable[Cell]) -> set[str]:
    """The commands; each line is one that they take.

    So that no study finds out at its end that an option is called otherwise.
    """
    seen: set[tuple[str, ...]] = set()
    for arguments in {cell.arguments for cell in in_order(cells)}:
        # Values differ from cell to cell; options are what could be wrong.
        options = (arguments[0], *(word for word in arguments if word.startswith("--")))
        if options in seen:
            continue
        seen.add(options)
        parsed = cli._parse(list(arguments))
        assert not isinstance(parsed, int), " ".join(arguments)
    return {options[0] for options in seen}


def outputs_of_several(cells: Iterable[Cell]) -> dict[str, set[str]]:
    """Outputs that more than one command line makes."""
    commands: dict[str, set[str]] = {}
    waiting = list(cells)
    while waiting:
        cell = waiting.pop()
        commands.setdefault(cell.output, set()).add(cell.command)
        waiting += cell.needs
    return {output: found for output, found in commands.items() if len(found) > 1}


def value(cell: Cell, option: str) -> str:
    """What follows an option."""
    return cell.arguments[cell.arguments.index(option) + 1]
