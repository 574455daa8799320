"""The study of contact without a sensor: its commands and its shares."""

import json
import math
from pathlib import Path

import pytest
from command_lines import commands_of

from contactgraph_studies.results import Reading, Results
from contactgraph_studies.sensing import (
    AS_TRAINED,
    FULL_SENSING,
    INFERRED,
    MEASURED,
    ONSET_DELAY_P95,
    PICKUP_SENSING,
    SCENE_SEED,
    UNMEASURED,
    WIDER,
    SensingStudy,
    SensorCondition,
    recovered_table,
    share_recovered,
)

STUDY = SensingStudy(FULL_SENSING)
ERROR = "n_step_rmse_planned_m"


def results_of(**values: dict) -> Results:
    """Of pickup with wider bodies: values by sensor, the same for both seeds."""
    readings = {}
    for slug, sensor in (("measured", MEASURED), ("nothing", UNMEASURED), ("motion", INFERRED)):
        where = SensorCondition(PICKUP_SENSING.name, WIDER.name, sensor.name)
        readings[where] = [Reading(seed, values[slug], f"command {slug}") for seed in (0, 1)]
    return Results(readings)


def test_every_cell_is_a_command_and_made_once() -> None:
    assert len({job.output for job in STUDY.jobs}) == len(STUDY.jobs) == len(STUDY.measurements)
    assert commands_of(STUDY.jobs) == {"control"}


def test_shares_by_hand() -> None:
    found = results_of(measured={ERROR: 0.02}, nothing={ERROR: 0.06}, motion={ERROR: 0.03})
    share = share_recovered(found, PICKUP_SENSING, WIDER, ERROR)
    assert f"| {WIDER.name} | 75 | - | - |" in recovered_table(found).markdown()
    assert share.values == pytest.approx((75.0,)) and share.command == "command motion"
    # No share if nothing was lost, or a number is not known or not measured.
    same = results_of(measured={ERROR: 0.0596}, nothing={ERROR: 0.06}, motion={ERROR: 0.0})
    assert not share_recovered(same, PICKUP_SENSING, WIDER, ERROR).known
    lost = results_of(measured={ERROR: 0.02}, nothing={ERROR: None}, motion={ERROR: 0.03})
    assert not share_recovered(lost, PICKUP_SENSING, WIDER, ERROR).known
    assert not share_recovered(found, PICKUP_SENSING, AS_TRAINED, ERROR).known


def test_a_contact_never_detected_counts() -> None:
    name = "onset_delay_ms_p95"
    found = results_of(
        measured={"onsets": 20, name: 50.0},
        nothing={"onsets": 20, name: None},
        motion={"onsets": 0, name: None},
    )
    delays = [
        found.statistic(
            SensorCondition(PICKUP_SENSING.name, WIDER.name, sensor.name), ONSET_DELAY_P95
        ).values
        for sensor in (MEASURED, UNMEASURED, INFERRED)
    ]
    assert delays == [(50.0, 50.0), (math.inf, math.inf), ()]


def test_result_from_the_existing_outputs(tmp_path: Path) -> None:
    said = {
        **{"success_rate": 0.9, "episodes": 20, "edge_f1_found": 0.97, "onsets": 20},
        **{"onset_delay_ms_p50": 0.0, "onset_delay_ms_p95": 50.0, ERROR: 0.04},
        **{"edge_f1_planned": 0.9, "plan_ms_p50": 1.0},
    }
    for one in STUDY.measurements[:15]:  # pickup, wider: five sensors, three seeds
        path = tmp_path / one.job.output
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({**said, "seed": SCENE_SEED + one.seed}))
    found = STUDY.result(tmp_path)
    first = found.tables[0].markdown().splitlines()[2]
    assert "| contacts measured | 90 % of 60 (79.9 to 95.3) | 0.97" in first
    assert len(found.tables[0].csv().splitlines()) == 1 + len(STUDY.measurements) // 3
    assert len(found.readings) == 15
    shares = found.tables[1].markdown().splitlines()[2:]
    assert shares[0] == f"| {WIDER.name} | - | - | - |", "all sensors are alike"
    assert len(shares) == len(PICKUP_SENSING.conditions)
