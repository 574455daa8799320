"""Every claim holds on numbers that fit it, and does not on numbers that contradict it."""

import json
import math

import pytest
from made_up import AMOUNTS, results

from contactgraph_studies.paper.claims import claims, data_ratio
from contactgraph_studies.paper.config import (
    DOOR,
    FRANKA,
    FULL_AB,
    GIM_NON_TEMP,
    GIM_TEMP,
    NO_GIM,
    NO_GIM_AUG,
    NO_KL,
    PICKUP,
    TASKS,
)
from contactgraph_studies.paper.jobs import Source
from contactgraph_studies.results import Results

ERROR = "n_step_rmse_planned_m"


def verdicts(measured: Results) -> dict[int, bool | None]:
    return {claim.number: claim.holds for claim in claims(measured, TASKS, AMOUNTS)}


def test_all_claims_hold_on_the_papers_numbers() -> None:
    assert verdicts(results()) == dict.fromkeys(range(1, 8), True)


@pytest.mark.parametrize(
    ("changed", "false"),
    [
        (({ERROR: 0.012}, NO_GIM_AUG, PICKUP.as_trained), {1}),
        (({ERROR: None}, GIM_NON_TEMP, DOOR.as_trained), {1}),
        (({ERROR: 0.02}, GIM_TEMP, DOOR.hardest), {2}),
        (({ERROR: 0.0081}, NO_GIM, PICKUP.hardest), {2}),
        (({"n_step_rmse_m": 0.001}, NO_GIM_AUG, None, Source.samples), {3}),
        (({"n_step_rmse_m": 0.1}, NO_GIM_AUG, None, Source.samples), {3}),
        (({"edge_accuracy_planned": 0.9995}, GIM_NON_TEMP), {4}),
        (({"edge_accuracy_unmeasured": 0.999}, GIM_TEMP), {4}),
        (({"growth_free": 1.0, "growth_driven": 2.0}, FULL_AB), {5}),
        (({"success_rate": 0.6}, FULL_AB, None, Source.long_plan), {5}),
        (({"edge_false_alarm_rate": 0.5}, NO_KL), {6}),
        (({ERROR: 0.01}, NO_KL, DOOR.hardest), {6}),
        (({"edge_false_alarm_rate": 0.02}, GIM_TEMP, PICKUP.as_trained), {7}),
        (({"edge_precision": 0.9}, GIM_NON_TEMP, PICKUP.hardest), {7}),
    ],
)
def test_each_claim_can_be_false(changed: tuple, false: set[int]) -> None:
    found = verdicts(results(*changed))
    assert {number for number, holds in found.items() if holds is False} == false
    assert None not in found.values()


def test_without_measurements_no_claim_is_evaluated() -> None:
    assert verdicts(Results({})) == dict.fromkeys(range(1, 8), None)
    for claim in claims(Results({}), TASKS, AMOUNTS):
        json.dumps(claim.to_json(), allow_nan=False)


def test_sentences_and_json_of_claims() -> None:
    found = {claim.number: claim for claim in claims(results(), TASKS, AMOUNTS)}
    first = "pickup: the largest error is 0.8 cm; multi-pickup: the largest error is 0.8 cm; "
    assert found[1].sentence == f"{first}door: the largest error is 0.8 cm."
    assert "pickup: No-GIM-Aug needs 3.5 times the data" in found[3].sentence
    never = results({"n_step_rmse_m": 0.1}, NO_GIM_AUG, source=Source.samples)
    third = {claim.number: claim for claim in claims(never, TASKS, AMOUNTS)}[3]
    assert "pickup: not reached with 160: No-GIM-Aug is at 10 cm" in third.sentence
    assert "more than 4 times the data" in third.sentence
    bad = results({ERROR: None}, NO_GIM, DOOR.as_trained)
    entry = claims(bad, TASKS, AMOUNTS)[0].to_json()
    assert entry["sentence"].endswith("door: the largest error is not finite.")
    assert [number["median"] for number in entry["numbers"] if number["task"] == "door"] == [
        pytest.approx(0.8),
        pytest.approx(0.8),
        "infinite",
        pytest.approx(0.8),
    ]
    json.dumps(entry, allow_nan=False)


def test_the_third_claim_is_evaluated_on_tasks_with_samples_only() -> None:
    found = {claim.number: claim.holds for claim in claims(results(), [DOOR], AMOUNTS)}
    assert found == dict.fromkeys((1, 2, 4, 5, 6, 7), True)


def test_claims_about_models_that_a_task_omits_are_not_evaluated() -> None:
    found = {claim.number: claim.holds for claim in claims(results(), [FRANKA], AMOUNTS)}
    assert found == {**dict.fromkeys((1, 2, 4, 7), True), 5: None, 6: None}


SIZES = (10, 20, 40, 80, 160)


@pytest.mark.parametrize(
    ("errors", "runs", "error", "ratio"),
    [
        # error = 8 / runs: 1/4 cm is reached with 32 runs.
        ([8.0 / size for size in SIZES], 16, 0.25, 2.0),
        # The first crossing counts.
        ([4.0, 1.0, 3.0, 1.0, 0.5], 10, 2.0, math.sqrt(2.0)),
        ([5.0, 4.0, 3.0, 3.0, 2.0], 40, 1.0, math.inf),
        ([0.5, 0.4, 0.3, 0.3, 0.2], 40, 1.0, 10 / 40),
        # Nothing to interpolate from: the size itself.
        ([math.inf, math.inf, 0.5, 0.4, 0.3], 40, 1.0, 1.0),
        ([math.nan] * 5, 40, 1.0, None),
        ([1.0] * 5, 40, math.nan, None),
        ([1.0] * 5, 40, math.inf, None),
    ],
)
def test_data_ratios_by_hand(
    errors: list[float], runs: int, error: float, ratio: float | None
) -> None:
    assert data_ratio(SIZES, errors, runs, error) == (ratio and pytest.approx(ratio))
