"""Every claim holds on numbers made up to fit it, and does not on those that speak against it."""

import json

import pytest
from made_up import AMOUNTS, results

from contactgraph_studies.claims import claims
from contactgraph_studies.declared import (
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
from contactgraph_studies.plan_cells import Source
from contactgraph_studies.results import Results


def verdicts(found: Results) -> dict[int, bool | None]:
    return {claim.number: claim.holds for claim in claims(found, TASKS, AMOUNTS)}


def test_all_hold_where_the_paper_is_right() -> None:
    assert verdicts(results()) == dict.fromkeys(range(1, 8), True)


ERROR = "n_step_rmse_planned_m"


@pytest.mark.parametrize(
    ("changed", "false"),
    [
        (results({ERROR: 0.012}, NO_GIM_AUG, PICKUP.as_trained), {1}),
        (results({ERROR: None}, GIM_NON_TEMP, DOOR.as_trained), {1}),
        (results({ERROR: 0.02}, GIM_TEMP, DOOR.hardest), {2}),
        (results({ERROR: 0.0081}, NO_GIM, PICKUP.hardest), {2}),
        (results({"n_step_rmse_m": 0.001}, NO_GIM_AUG, source=Source.samples), {3}),
        (results({"n_step_rmse_m": 0.1}, NO_GIM_AUG, source=Source.samples), {3}),
        (results({"edge_accuracy_planned": 0.9995}, GIM_NON_TEMP), {4}),
        (results({"edge_accuracy_unmeasured": 0.999}, GIM_TEMP), {4}),
        (results({"growth_free": 1.0, "growth_driven": 2.0}, FULL_AB), {5}),
        (results({"success_rate": 0.6}, FULL_AB, source=Source.long_plan), {5}),
        (results({"edge_false_alarm_rate": 0.5}, NO_KL), {6}),
        (results({ERROR: 0.01}, NO_KL, DOOR.hardest), {6}),
        (results({"edge_false_alarm_rate": 0.02}, GIM_TEMP, PICKUP.as_trained), {7}),
        (results({"edge_precision": 0.9}, GIM_NON_TEMP, PICKUP.hardest), {7}),
    ],
)
def test_each_can_be_false(changed: Results, false: set[int]) -> None:
    found = verdicts(changed)
    assert {number for number, holds in found.items() if holds is False} == false
    assert None not in found.values()


def test_nothing_measured_is_not_known() -> None:
    assert verdicts(Results({})) == dict.fromkeys(range(1, 8), None)
    for claim in claims(Results({}), TASKS, AMOUNTS):
        json.dumps(claim.to_json(), allow_nan=False)


def test_what_a_claim_says() -> None:
    found = {claim.number: claim for claim in claims(results(), TASKS, AMOUNTS)}
    assert found[1].sentence == "The largest median error of any of these models is 0.8 cm."
    assert "pickup: No-GIM-Aug needs 3.5 times the data" in found[3].sentence
    never = results({"n_step_rmse_m": 0.1}, NO_GIM_AUG, source=Source.samples)
    third = {claim.number: claim for claim in claims(never, TASKS, AMOUNTS)}[3]
    assert "pickup: not reached with 160: No-GIM-Aug is at 10 cm" in third.sentence
    assert "more than 4 times the data" in third.sentence
    bad = results({ERROR: None}, NO_GIM, DOOR.as_trained)
    first = {claim.number: claim for claim in claims(bad, TASKS, AMOUNTS)}[1]
    assert first.sentence == (
        "1 cm or more: No-GIM on pickup (not finite) and No-GIM on door (not finite)."
    )
    told = first.to_json()
    assert [number["median"] for number in told["numbers"] if number["task"] == "door"] == [
        pytest.approx(0.8),
        pytest.approx(0.8),
        "infinite",
        pytest.approx(0.8),
    ]
    json.dumps(told, allow_nan=False)


def test_the_third_is_of_tasks_with_samples_only() -> None:
    found = {claim.number: claim.holds for claim in claims(results(), [DOOR], AMOUNTS)}
    assert found == dict.fromkeys((1, 2, 4, 5, 6, 7), True)


def test_what_a_task_leaves_out_is_not_known_there() -> None:
    found = {claim.number: claim.holds for claim in claims(results(), [FRANKA], AMOUNTS)}
    assert found == {**dict.fromkeys((1, 2, 4, 7), True), 5: None, 6: None}
