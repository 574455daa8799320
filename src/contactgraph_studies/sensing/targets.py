"""What contact without a sensor must reach, beside what it reaches."""

from collections.abc import Sequence

from contactgraph.viz import Number
from contactgraph_studies.results import Results
from contactgraph_studies.sensing.declared import (
    INFERRED,
    PICKUP_SENSING,
    SensingAmounts,
    SensingTask,
)
from contactgraph_studies.sensing.results import Sensed, delay_ms, share_recovered
from contactgraph_studies.targets import Asked, judged

_EDGE_F1 = Asked(0.85, 0.95)
_DELAY_MS = Asked(50.0, 20.0)
_SHARE = Asked(50.0, 90.0)
_GAINS = {
    "n_step_rmse_planned_m": "the planned error",
    "edge_f1_found": "edge F1",
    "success_rate": "success",
}


def sensing_targets(
    results: Results, tasks: Sequence[SensingTask], amounts: SensingAmounts
) -> tuple[Number, ...]:
    """Every row of the table of targets."""
    numbers = []
    for task in tasks:
        for condition in task.conditions:
            where = Sensed(task.name, condition.name, INFERRED.name)
            label = f"{task.name}, {condition.name}, by motion alone"
            f1 = results.number(where, "edge_f1_found")
            delay = delay_ms(results, where, "onset_delay_ms_p95")
            numbers += [
                judged(f"{label}: edge F1", "", f1, _EDGE_F1, amounts.seeds),
                judged(
                    f"{label}: onset delay, 95 %",
                    "ms",
                    delay,
                    _DELAY_MS,
                    amounts.seeds,
                    lower_is_better=True,
                ),
            ]
    for condition in PICKUP_SENSING.conditions:
        for key, name in _GAINS.items():
            share = share_recovered(results, PICKUP_SENSING, condition, key)
            label = f"{PICKUP_SENSING.name}, {condition.name}: share of what contacts measured gain"
            nothing = "" if share.known else " (they gain nothing)"
            asked = _SHARE if share.known else None
            numbers.append(judged(f"{label} in {name}{nothing}", "%", share, asked, amounts.seeds))
    return tuple(numbers)
