"""The study on a simulated robot: its jobs, and its table from made-up numbers."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from contactgraph.cli.main import parse
from contactgraph_studies.simulated_robot import (
    BY_FINGERS,
    BY_MOTION,
    FULL_SIM,
    LIVE,
    QUICK_SIM,
    SMOOTHED,
    TRAINING,
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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "cells").mkdir()
    for name, values in NUMBERS.items():
        (tmp_path / "cells" / f"{name}.json").write_text(json.dumps(values))
    return tmp_path


def test_every_command_is_valid_and_follows_its_inputs() -> None:
    for amounts in (FULL_SIM, QUICK_SIM):
        made: set[str] = set()
        for job in SimulatedRobotStudy(amounts).jobs:
            assert not isinstance(parse(list(job.arguments)), int), job.command
            assert {need.output for need in job.needs} <= made
            made.add(job.output)


def test_the_amounts_are_the_papers() -> None:
    counts = (FULL_SIM.training_runs, FULL_SIM.validation_runs, FULL_SIM.seconds)
    assert counts == (25, 5, 10.0) and FULL_SIM.episodes == 20


def test_the_table_has_every_number_that_is_known(folder: Path) -> None:
    found = SimulatedRobotStudy(FULL_SIM).result(folder)
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
    assert not any(what == controlled(BY_MOTION).source for what, _ in rows)
    assert "| training runs" in found.tables[0].markdown()
    sources = [reading["source"] for reading in found.readings]
    assert len(sources) == len(NUMBERS)
    assert {TRAINING.source, LIVE.source, controlled(BY_FINGERS).source} < set(sources)


def test_the_summary_names_the_number_of_episodes(folder: Path) -> None:
    study = SimulatedRobotStudy(replace(FULL_SIM, episodes=3))
    assert "3 pickups by MPC" in study.result(folder).summary
