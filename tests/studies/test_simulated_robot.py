"""The study on a simulated robot: its table from made-up numbers."""

import json
from pathlib import Path

import pytest

from contactgraph_studies.simulated_robot import (
    BY_FINGERS,
    BY_MOTION,
    FULL_SIM,
    LIVE,
    SMOOTHED,
    VALIDATION,
    SimulatedRobotStudy,
    controlled,
)

NUMBERS = {
    "training": {"runs": 25, "rate_hz": 990.0, "position_error_m": 0.0003},
    "validation": {
        "runs": 5,
        "completed": 5,
        "rate_hz": 998.0,
        "position_error_m": 0.0004,
        "position_error_worst_m": 0.012,
    },
    "followed": {"n_step_rmse_inferred_m": 0.009, "n_step_rmse_m": 0.008, "edge_f1": None},
    "followed-live": {"edge_f1_inferred": 0.9, "switch_time_error_inferred_s": 0.03},
    "control-fingers": {
        "successes": 18,
        "success_rate": 0.9,
        "episodes": 20,
        "plan_ms_p50": 9.0,
        "each": [],
    },
}


def test_the_table_has_every_number_that_is_known(tmp_path: Path) -> None:
    (tmp_path / "cells").mkdir()
    for name, values in NUMBERS.items():
        (tmp_path / "cells" / f"{name}.json").write_text(json.dumps(values))
    found = SimulatedRobotStudy(FULL_SIM).result(tmp_path)
    assert "validation runs,position_error_worst_m,mm,12.0" in found.tables[0].csv()
    assert "edge_f1," not in found.tables[0].csv()
    rows = {(row["What"], row["number"]): row["value"] for row in found.tables[0].rows}
    smoothed, fingers = SMOOTHED.source, controlled(BY_FINGERS).source
    assert rows[smoothed, "n_step_rmse_inferred_m"] == pytest.approx(0.9)
    assert rows[LIVE.source, "edge_f1_inferred"] == 0.9
    assert rows[LIVE.source, "switch_time_error_inferred_s"] == pytest.approx(30.0)
    assert rows[VALIDATION.source, "rate_hz"] == 998.0
    assert rows[VALIDATION.source, "position_error_m"] == pytest.approx(0.4)
    assert (rows[fingers, "successes"], rows[fingers, "episodes"]) == (18, 20)
    assert len(found.readings) == len(NUMBERS)
    assert not any(what == controlled(BY_MOTION).source for what, _ in rows)
