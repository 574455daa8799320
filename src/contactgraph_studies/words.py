"""Numbers as a reader sees them."""

from collections.abc import Sequence

from contactgraph.viz.number_table import short as short
from contactgraph.viz.number_table import with_unit as with_unit
from contactgraph_studies.results import Figure


def with_range(figure: Figure, unit: str = "") -> str:
    """The median, and the range where there are several seeds."""
    if not figure.known:
        return "not known"
    told = with_unit(figure.median, unit)
    if len(figure.values) == 1:
        return told
    return f"{told} ({short(figure.low)} to {short(figure.high)})"


def joined(parts: Sequence[str]) -> str:
    """``a, b and c``."""
    if len(parts) < 2:
        return "".join(parts)
    return f"{', '.join(parts[:-1])} and {parts[-1]}"
