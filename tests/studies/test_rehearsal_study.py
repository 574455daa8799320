"""The rehearsed experiment's plan, and what it makes of its cells' numbers."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from contactgraph.cli import main as cli
from contactgraph_studies.sim.cells import Controlled, Followed, Recorded
from contactgraph_studies.sim.declared import BY_FINGERS, FULL_REHEARSAL, QUICK_REHEARSAL
from contactgraph_studies.sim.study import RehearsalStudy

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


def test_every_command_is_one_of_ours_and_follows_what_it_needs() -> None:
    for amounts in (FULL_REHEARSAL, QUICK_REHEARSAL):
        made: set[str] = set()
        for cell in RehearsalStudy(amounts).cells:
            assert not isinstance(cli._parse(list(cell.arguments)), int), cell.command
            assert {need.output for need in cell.needs} <= made
            made.add(cell.output)


def test_the_amounts_are_the_papers() -> None:
    counts = (FULL_REHEARSAL.training_runs, FULL_REHEARSAL.validation_runs, FULL_REHEARSAL.seconds)
    assert counts == (25, 5, 10.0) and FULL_REHEARSAL.episodes == 20


def test_targets_are_judged_by_what_was_measured(folder: Path) -> None:
    found = RehearsalStudy(FULL_REHEARSAL).findings(folder)
    values = {number.name: number.value for number in found.targets}
    by_unit = [round(value, 6) for value in values.values() if value is not None]
    assert by_unit == [0.9, 90.0, 0.9, 30.0, 998.0, 0.4, 12.0]
    # What was not measured is not known, and nothing is said of it.
    assert [name for name, value in values.items() if value is None] == [
        "dynamic pickups that succeed, of 20; contacts by the fingers' width, and by motion"
    ]


def test_the_table_has_every_number_that_is_known(folder: Path) -> None:
    found = RehearsalStudy(FULL_REHEARSAL).findings(folder)
    assert "validation runs,position_error_worst_m,mm,12.0" in found.table_csv
    assert "edge_f1," not in found.table_csv
    assert "| training runs" in found.table_markdown
    sources = [reading["source"] for reading in found.readings]
    assert len(sources) == len(NUMBERS)
    assert str(Recorded("training")) in sources and str(Followed(live=True)) in sources
    assert str(Controlled(BY_FINGERS)) in sources


def test_fewer_episodes_are_said_to_be_fewer(folder: Path) -> None:
    study = RehearsalStudy(replace(FULL_REHEARSAL, episodes=3))
    assert "3 pickups by MPC" in study.findings(folder).summary
