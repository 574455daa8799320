"""The study on a simulated robot: its jobs, and tables and targets from made-up numbers."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from contactgraph.cli.main import parse
from contactgraph_studies.simulated_robot import (
    BY_FINGERS,
    FULL_SIM,
    LIVE,
    QUICK_SIM,
    TRAINING,
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


def test_targets_are_compared_with_the_measured_numbers(folder: Path) -> None:
    found = SimulatedRobotStudy(FULL_SIM).result(folder)
    values = {number.name: number.value for number in found.targets}
    by_unit = [round(value, 6) for value in values.values() if value is not None]
    assert by_unit == [0.9, 90.0, 0.9, 30.0, 998.0, 0.4, 12.0]
    assert [name for name, value in values.items() if value is None] == [
        "dynamic pickups that succeed, of 20; contacts by the fingers' width, and by motion"
    ]


def test_the_table_has_every_number_that_is_known(folder: Path) -> None:
    found = SimulatedRobotStudy(FULL_SIM).result(folder)
    assert "validation runs,position_error_worst_m,mm,12.0" in found.tables[0].csv()
    assert "edge_f1," not in found.tables[0].csv()
    assert "| training runs" in found.tables[0].markdown()
    sources = [reading["source"] for reading in found.readings]
    assert len(sources) == len(NUMBERS)
    assert {TRAINING.source, LIVE.source, controlled(BY_FINGERS).source} < set(sources)


def test_the_summary_names_the_number_of_episodes(folder: Path) -> None:
    study = SimulatedRobotStudy(replace(FULL_SIM, episodes=3))
    assert "3 pickups by MPC" in study.result(folder).summary
