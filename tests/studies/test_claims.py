"""Every claim holds on numbers that fit it, and does not on numbers that contradict it."""

import json
import math

import numpy as np
import pytest
from made_up import AMOUNTS, results

from contactgraph_studies.bootstrap import Estimate, Sample, Verdict, all_hold, estimate, mean
from contactgraph_studies.paper.claims import claims, data_ratio
from contactgraph_studies.paper.config import DOOR, FAMILIES, FRANKA, LITERAL, OURS, PICKUP, TASKS
from contactgraph_studies.paper.jobs import Source
from contactgraph_studies.results import Results

ERROR, OPEN = "n_step_rmse_planned_moving_by_episode_m", "n_step_rmse_moving_by_run_m"
SUCCESS = "success_by_episode"
HOLDS, FAILS = Verdict.HOLDS, Verdict.FAILS


def verdicts(measured: Results) -> dict[str, dict[int, Verdict]]:
    """By family and number of the claim."""
    found: dict[str, dict[int, Verdict]] = {}
    for claim in claims(measured, TASKS, AMOUNTS):
        found.setdefault(claim.family, {})[claim.number] = claim.verdict
    return found


def test_all_claims_hold_on_the_papers_numbers() -> None:
    expected = {family.name: dict.fromkeys(range(1, 8), HOLDS) for family in FAMILIES}
    assert verdicts(results()) == expected


@pytest.mark.parametrize(
    ("changed", "false"),
    [
        (({ERROR: [0.012]}, OURS.no_gim_aug, PICKUP.as_trained), {1}),
        (({ERROR: ["infinite"]}, OURS.gim_non_temp, DOOR.as_trained), {1}),
        (({ERROR: [0.02]}, OURS.gim_temp, DOOR.hardest), {2}),
        (({ERROR: [0.0081]}, OURS.no_gim, PICKUP.hardest), {2}),
        (({OPEN: [0.001]}, OURS.no_gim_aug, None, Source.samples), {3}),
        (({OPEN: [0.1]}, OURS.no_gim_aug, None, Source.samples), {3}),
        (({"edge_accuracy_planned": 0.9995}, OURS.gim_non_temp), {4}),
        (({"edge_accuracy_unmeasured": 0.999}, OURS.gim_temp), {4}),
        (({"growth_free": 1.0, "growth_driven": 2.0}, OURS.full_ab), {5}),
        (({SUCCESS: [True] * 20}, OURS.full_ab, None, Source.long_plan), {5}),
        (({"edge_false_alarm_rate": 0.5}, OURS.no_kl), {6}),
        (({ERROR: [0.01]}, OURS.no_kl, DOOR.hardest), {6}),
        (({"edge_false_alarm_rate": 0.02}, OURS.gim_temp, PICKUP.as_trained), {7}),
        (({"edge_precision": 0.9}, OURS.gim_non_temp, PICKUP.hardest), {7}),
    ],
)
def test_each_claim_can_be_false(changed: tuple, false: set[int]) -> None:
    found = verdicts(results(*changed))
    assert {number for number, verdict in found["ours"].items() if verdict is FAILS} == false
    assert set(found["ours"].values()) == {HOLDS, FAILS}
    assert set(found[LITERAL.name].values()) == {HOLDS}, "another family"


def test_what_trainings_or_scenes_leave_open_cannot_be_told() -> None:
    """Of 20 scenes, ten have errors above the bound of 1 cm, so draws lie on both sides of it."""
    some = results({ERROR: [0.0085, 0.0115] * 10}, OURS.no_gim, PICKUP.as_trained)
    assert verdicts(some)["ours"][1] is Verdict.UNDECIDED
    nothing = results({ERROR: [None] * 20}, OURS.no_gim, PICKUP.as_trained)
    assert verdicts(nothing)["ours"][1] is Verdict.UNDECIDED, "a controller that moves nothing"


def test_without_measurements_no_claim_is_evaluated() -> None:
    found = claims(Results({}), TASKS, AMOUNTS)
    assert {claim.number for claim in found} == set(range(1, 8))
    for claim in found:
        assert claim.verdict is Verdict.UNKNOWN
        json.dumps(claim.to_json(), allow_nan=False)


def test_an_infinite_error_is_a_word_in_json() -> None:
    bad = results({ERROR: ["infinite"]}, OURS.no_gim, DOOR.as_trained)
    entry = claims(bad, TASKS, AMOUNTS)[2].to_json()
    assert (entry["family"], entry["verdict"], entry["holds"]) == ("ours", "does not hold", False)
    errors = [each for each in entry["numbers"] if "success" not in each["name"]]
    of_door = [number["median"] for number in errors if number["task"] == "door"]
    small = pytest.approx(0.8)
    assert of_door == [small, small, "infinite", small, "infinite"]
    json.dumps(entry, allow_nan=False)


def test_claims_about_samples_or_models_that_a_task_omits_are_not_evaluated() -> None:
    for task, numbers in ((DOOR, (1, 2, 4, 5, 6, 7)), (FRANKA, (1, 2, 4, 7))):
        found = claims(results(), [task], AMOUNTS)
        assert {claim.number: claim.verdict for claim in found} == dict.fromkeys(numbers, HOLDS)
    assert {claim.family for claim in found} == {"ours"}, "of the arm"


def test_intervals_count_trainings_and_scenes_once() -> None:
    """Against the formula for the mean of normal numbers, of trainings and of scenes."""
    rng = np.random.default_rng(0)
    scenes = rng.normal(size=400)
    same = Sample({seed: 5.0 + scenes for seed in range(5)}, "a", mean)
    found = estimate([same])
    spread = 1.96 * scenes.std() / 20.0
    assert (found.high - found.low) / 2.0 == pytest.approx(spread, rel=0.1), "not five times 400"
    apart = Sample({seed: np.array([float(seed)]) for seed in range(5)}, None, mean)
    found = estimate([apart])
    assert (found.value, found.each) == (2.0, (0.0, 1.0, 2.0, 3.0, 4.0))
    assert 0.0 <= found.low < 1.0 and 3.0 < found.high <= 4.0
    both = estimate([same, same], np.subtract)
    assert (both.low, both.high) == (0.0, 0.0), "the same trainings and scenes of both"
    known = Sample({0: np.array([1.0, np.nan, 3.0])}, "a", mean)
    assert estimate([known]).value == 2.0
    diverged = estimate([Sample({0: np.array([1.0, np.inf])}, "a")])
    assert (diverged.value, diverged.high) == (math.inf, math.inf)


def test_verdicts_of_intervals() -> None:
    one = Estimate(1.0, 0.9, 1.1, (1.0,), trainings=1)
    assert (one.below(1.2), one.below(0.8), one.below(1.0)) == (HOLDS, FAILS, Verdict.UNDECIDED)
    assert one.below(1.1) is Verdict.UNDECIDED and one.above(0.8) is HOLDS
    assert Estimate().below(1.0) is Verdict.UNKNOWN
    assert all_hold([HOLDS, Verdict.UNDECIDED]) is Verdict.UNDECIDED
    assert all_hold([Verdict.UNKNOWN, Verdict.UNDECIDED, HOLDS]) is Verdict.UNKNOWN
    assert all_hold([FAILS, Verdict.UNKNOWN]) is FAILS and all_hold([]) is Verdict.UNKNOWN


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
