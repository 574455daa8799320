"""What the rehearsed experiment must reach, beside what it reaches."""

import math

from contactgraph.viz import Number
from contactgraph_studies.results import Figure, Results
from contactgraph_studies.sim.cells import VALIDATION, Controlled, Followed, Place
from contactgraph_studies.sim.declared import WAYS, RehearsalAmounts
from contactgraph_studies.targets import Asked, judged

_ERROR_CM = Asked(2.5, 1.0)
"""At least as well as the paper on its arm."""
_SUCCESS = Asked(75.0, 100.0)
_EDGE_F1 = Asked(0.85, 0.95)
_DELAY_MS = Asked(50.0, 20.0)
_RATE_HZ = Asked(500.0, 1000.0)
_TAG_MM = Asked(2.0, 0.5)
_TAG_WORST_MM = Asked(10.0, 3.0)


def rehearsal_targets(results: Results, amounts: RehearsalAmounts) -> tuple[Number, ...]:
    """Every row of the table of targets."""
    seeds = (0,)

    def row(
        name: str, unit: str, figure: Figure, asked: Asked, lower_is_better: bool = True
    ) -> Number:
        return judged(name, unit, figure, asked, seeds, lower_is_better)

    smoothed, live = Followed(live=False), Followed(live=True)
    delay = scaled(results, live, "switch_time_error_inferred_s", 1000.0)
    return (
        row(
            "N-step error over 0.5 s, tracked states, no contact sensor",
            "cm",
            results.error_cm(smoothed, "n_step_rmse_inferred_m"),
            _ERROR_CM,
        ),
        *(
            row(
                f"dynamic pickups that succeed, of {amounts.episodes}; contacts {way.name}",
                "%",
                results.number(Controlled(way), "success_rate", 100.0),
                _SUCCESS,
                lower_is_better=False,
            )
            for way in WAYS
        ),
        row(
            "contacts found without a sensor, by what was seen then: edge F1",
            "",
            results.number(live, "edge_f1_inferred"),
            _EDGE_F1,
            lower_is_better=False,
        ),
        row("the same: mean time from a contact's onset to its belief", "ms", delay, _DELAY_MS),
        row(
            "feedback loop, the slowest run, on the arm's clock",
            "Hz",
            results.number(VALIDATION, "rate_hz"),
            _RATE_HZ,
            lower_is_better=False,
        ),
        row(
            "block's position in recorded runs, median error",
            "mm",
            scaled(results, VALIDATION, "position_error_m", 1000.0),
            _TAG_MM,
        ),
        row(
            "block's position in recorded runs, worst error",
            "mm",
            scaled(results, VALIDATION, "position_error_worst_m", 1000.0),
            _TAG_WORST_MM,
        ),
    )


def scaled(results: Results, where: Place, key: str, scale: float) -> Figure:
    """A number that may be null: then it is not known."""

    def value(values: dict) -> float:
        told = values.get(key)
        return math.nan if told is None else scale * float(told)

    return results.derived(where, value)
