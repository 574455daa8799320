"""Table, figures and report of the study of models, from made-up numbers."""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from made_up import AMOUNTS, by_the_paper, pixels, results
from matplotlib.figure import Figure

from contactgraph.evaluate import wilson_interval
from contactgraph_studies.paper.claims import claims
from contactgraph_studies.paper.config import (
    DOOR,
    FAMILIES,
    OURS,
    PICKUP,
    TASKS,
    StudyModel,
    StudyTask,
)
from contactgraph_studies.paper.figures import error_figure
from contactgraph_studies.paper.jobs import ModelCondition, planned
from contactgraph_studies.paper.study import OMITTED, model_table
from contactgraph_studies.results import Reading, Results, Success
from contactgraph_studies.tables import StudyTable

ERROR, BY_EPISODE = "n_step_rmse_planned_m", "n_step_rmse_planned_moving_by_episode_m"


def read_csv(table: StudyTable) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(table.csv())))


def table_of(measured: Results, tasks: Sequence[StudyTask] = (PICKUP,)) -> StudyTable:
    return model_table(measured, tasks, AMOUNTS)


def row_of(rows: Sequence[dict[str, str]], model: StudyModel) -> dict[str, str]:
    return next(row for row in rows if row["model"] == model.name)


def test_one_row_for_each_task_condition_and_model() -> None:
    rows = read_csv(table_of(results({ERROR: None}, OURS.full_ab), TASKS))
    models = [model for family in FAMILIES for model in family.models]
    assert len(rows) == 3 * 2 * len(models), "the extra condition is left out"
    first, free = row_of(rows, OURS.gim_temp), row_of(rows, OURS.full_ab)
    assert list(first.values())[:5] == ["pickup", "as trained", "True", "GIM-Temp", "3"]
    ends = [float(first[f"planned_moving_cm_{end}"]) for end in ("median", "low", "high")]
    assert ends == pytest.approx([0.8] * 3)
    # Three trainings in the same 20 scenes: n is 20.
    assert [first[f"{name}_every_step"] for name in ("successes", "episodes")] == ["20", "20"]
    assert [first[name] for name in ("successes", "episodes")] == ["20", "20"]
    assert first["percent_of_each_seed"] == "100 100 100"
    folder = "cells/pickup/seed-0/ours-recurrent-40/run"
    assert first["command_closed_loop"].startswith(f"contactgraph control {folder} ")
    assert first["command_open_loop"].startswith("contactgraph evaluate ")
    assert (free["successes"], free["successes_every_step"]) == ("2", "")
    assert free["planned_cm_median"] == "inf"


def test_missing_measurements_are_empty_cells() -> None:
    row = read_csv(table_of(Results({})))[0]
    empty = ("planned_cm_median", "successes", "command_open_loop")
    assert [row[name] for name in (*empty, "seeds")] == ["", "", "", "0"]


def test_an_error_of_moving_bodies_is_not_known_if_nothing_moves() -> None:
    def unstable(change: dict[str, Any]) -> dict[str, str]:
        return row_of(read_csv(table_of(results(change, OURS.full_ab))), OURS.full_ab)

    unknown = {"n_step_rmse_planned_moving_m": None, BY_EPISODE: [None] * 20}
    still = unstable(unknown)
    assert still["planned_moving_cm_median"] == still["planned_cm_median"] == ""
    resting = {**unknown, ERROR: None, "planned_windows": 8, "planned_moved_objects": 0}
    unmoved = unstable(resting)
    assert unmoved["planned_moving_cm_median"] == unmoved["planned_cm_median"] == ""
    diverged = unstable({BY_EPISODE: [*19 * [0.01], "infinite"]})
    assert diverged["planned_moving_cm_median"] == "inf"


def test_a_cell_is_the_median_over_seeds_with_their_range() -> None:
    condition = planned(DOOR, OURS.gim_temp, DOOR.hardest)
    readings = [
        Reading(seed, {**by_the_paper(condition), ERROR: error}, "contactgraph control")
        for seed, error in enumerate((0.001, 0.0055, 0.05))
    ]
    table = table_of(Results({condition: readings}), [DOOR])
    assert "| 0.55 (0.1 to 5) |" in table.markdown()
    row = next(row for row in read_csv(table) if row["planned_cm_median"])
    values = [float(row[f"planned_cm_{end}"]) for end in ("median", "low", "high")]
    assert values == pytest.approx([0.55, 0.1, 5.0])


FIGURES: list[Callable[[Results], Figure]] = [
    lambda measured: error_figure(measured, [DOOR]),
]


@pytest.mark.parametrize("draw", FIGURES)
def test_figures_show_measurements_and_need_none(draw: Callable[[Results], Figure]) -> None:
    assert not np.array_equal(pixels(draw(Results({}))), pixels(draw(results())))


def test_results_json_keeps_what_claims_and_tables_need() -> None:
    measured, kept = results(), {}
    for entry in measured.to_json("training_seed", OMITTED):
        condition = ModelCondition(
            **{each.name: entry[each.name] for each in fields(ModelCondition)}
        )
        reading = Reading(entry["training_seed"], entry["values"], entry["command"])
        kept.setdefault(condition, []).append(reading)
    shown = [
        (table_of(each, TASKS).csv(), [one.to_json() for one in claims(each, TASKS, AMOUNTS)])
        for each in (measured, Results(kept))
    ]
    assert shown[0] == shown[1]


def test_trainings_in_the_same_scenes_are_not_pooled() -> None:
    each, episodes = (100, 97, 98), (100, 100, 100)
    same = Success(each, episodes, (2000, 2000, 2000))
    assert same.trials == (98, 100) and same.rate == 0.98
    assert same.interval == wilson_interval(98, 100)
    assert str(same) == "100, 97, 98 % of the same 100 (median: 93 to 99.4)"
    assert Success((9, 4), (10, 10), (5, 5)).trials == (4, 10), "of two, the worse"
    assert Success(each, episodes, (None,) * 3).trials == (98, 100), "not recorded: the same"
    apart = Success(each, episodes, (1, 2, 3))
    assert apart.trials == (295, 300) and apart.interval == wilson_interval(295, 300)
    assert str(apart) == "98.3 % of 300 (96.2 to 99.3)"
    one = Success((9,), (10,), (5,))
    assert one.trials == (9, 10) and str(one) == "90 % of 10 (59.6 to 98.2)"
