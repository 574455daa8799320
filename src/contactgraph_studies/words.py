"""Numbers as a reader sees them."""

import math
from collections.abc import Sequence

from contactgraph_studies.results import Figure


def short(value: float) -> str:
    """Three significant digits, without an exponent where it can be read without."""
    if math.isnan(value):
        return "not known"
    if math.isinf(value):
        return "not finite"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.2g}"
    if abs(value) >= 100.0:
        return f"{value:.0f}"
    return f"{value:.3g}"


def with_unit(value: float, unit: str) -> str:
    """As `short`; a unit behind words would read oddly."""
    return f"{short(value)} {unit}".strip() if math.isfinite(value) else short(value)


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
