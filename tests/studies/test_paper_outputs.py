"""Table, figures and report of the study of models, from made-up numbers."""

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up import AMOUNTS, by_the_paper, pixels, results
from matplotlib.figure import Figure
from matplotlib.image import imread

from contactgraph.evaluate import wilson_interval
from contactgraph_studies.figures import new_figure, write_figure
from contactgraph_studies.outputs import study_report
from contactgraph_studies.paper.claims import claims
from contactgraph_studies.paper.config import (
    DOOR,
    FAMILIES,
    LITERAL,
    OURS,
    PICKUP,
    TASKS,
    StudyModel,
    StudyTask,
)
from contactgraph_studies.paper.figures import (
    error_figure,
    fault_figure,
    sample_figure,
)
from contactgraph_studies.paper.jobs import ModelCondition, planned
from contactgraph_studies.paper.study import OMITTED, model_table
from contactgraph_studies.results import (
    Reading,
    Results,
    SeedStatistic,
    Success,
    joined,
    with_range,
)
from contactgraph_studies.study import Picture, StudyResult
from contactgraph_studies.tables import StudyTable

ERROR, BY_EPISODE = "n_step_rmse_planned_m", "n_step_rmse_planned_moving_by_episode_m"


def read_csv(table: StudyTable) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(table.csv())))


def table_of(measured: Results, tasks: Sequence[StudyTask] = (PICKUP,)) -> StudyTable:
    return model_table(measured, tasks, AMOUNTS)


def row_of(rows: Sequence[dict[str, str]], model: StudyModel) -> dict[str, str]:
    return next(row for row in rows if row["model"] == model.name)


def test_one_row_for_each_task_condition_and_model() -> None:
    rows = read_csv(table_of(results(), TASKS))
    models = [model for family in FAMILIES for model in family.models]
    assert len(rows) == 3 * 2 * len(models), "the extra condition is left out"
    first, free = row_of(rows, OURS.gim_temp), row_of(rows, OURS.full_ab)
    assert list(first)[:6] == [
        *("task", "scenes", "in_distribution", "model", "seeds"),
        "planned_moving_cm_median",
    ]
    assert list(first.values())[:11] == [
        *("pickup", "as trained", "True", "GIM-Temp", "3"),
        *3 * ("0.8000000000000002",),
        *3 * ("0.8",),
    ]
    # Three trainings in the same 20 scenes: n is 20.
    assert (first["successes"], first["episodes"], first["episodes_every_step"]) == (
        *("20", "20"),
        "20",
    )
    assert first["percent_of_each_seed"] == "100 100 100"
    folder = "cells/pickup/seed-0/gim-temp-40/run"
    assert first["command_closed_loop"].startswith(f"contactgraph control {folder} ")
    assert first["command_open_loop"].startswith("contactgraph evaluate ")
    assert (free["successes"], free["successes_every_step"]) == ("2", "")


def test_markdown_and_csv_agree() -> None:
    table = table_of(results({ERROR: None}, OURS.full_ab))
    markdown = table.markdown().splitlines()
    own, free = (f"| pickup | as trained | {each.kind} |" for each in (OURS.gim_temp, OURS.full_ab))
    first, unstable = (
        next(one for one in markdown if one.startswith(each)) for each in (own, free)
    )
    assert len(markdown) == 2 + len(read_csv(table))
    assert markdown[1] == "|" + 13 * "---|"
    assert first.startswith(f"{own} 0.8 (0.8 to 0.8) | 0.8 ")
    same = "100, 100, 100 % of the same 20 (median: 83.9 to 100)"
    assert first.endswith(f"| {same} | {same} |")
    assert "| 0.8 (0.8 to 0.8) | not finite (not finite to not finite) |" in unstable
    assert unstable.endswith("| 10, 10, 10 % of the same 20 (median: 2.79 to 30.1) |  |")
    assert row_of(read_csv(table), OURS.full_ab)["planned_cm_median"] == "inf"


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
    line = next(one for one in table.markdown().splitlines() if "| 0.55 (0.1 to 5) |" in one)
    assert line.startswith("| door | 10 more doors | GIM-Temp |")
    assert line.endswith("|  |"), "success at every step is not measured"
    row = next(row for row in read_csv(table) if row["planned_cm_median"])
    values = [float(row[f"planned_cm_{end}"]) for end in ("median", "low", "high")]
    assert values == pytest.approx([0.55, 0.1, 5.0])


def test_the_report_begins_with_verdicts() -> None:
    result = StudyResult(
        title="Study 1",
        summary="in short",
        claims=claims(results({BY_EPISODE: [0.02]}, LITERAL.no_gim), TASKS, AMOUNTS),
        tables=[table_of(results())],
        figures=[Picture("Errors", "in cm", "figures/errors.png")],
        amounts={},
        readings=[],
    )
    failures = [("contactgraph x", "exit code 2")]
    report = study_report(result, failures, ["contactgraph reproduce all"], "today")
    assert report.startswith("# Study 1\n\nin short\n\n## What the paper claims\n")
    assert report.count("\n> ") == 7, "each claim once, for all families"
    assert report.index("- as written: **does not hold**. ") < report.index("## Errors")
    assert report.index("- ours: **holds**. ") < report.index("## Errors")
    assert "\n- `contactgraph x`: exit code 2\n" in report
    assert "\n![Errors](figures/errors.png)\n\nin cm\n" in report
    assert table_of(results()).markdown() in report
    assert report.endswith("\ntoday\n\n```sh\ncontactgraph reproduce all\n```\n")


FIGURES: list[Callable[[Results], Figure]] = [
    lambda measured: error_figure(measured, [DOOR]),
    lambda measured: fault_figure(measured, [DOOR]),
    lambda measured: sample_figure(measured, [PICKUP], AMOUNTS),
]


@pytest.mark.parametrize("draw", FIGURES)
def test_figures_are_reproducible_and_need_no_measurement(
    draw: Callable[[Results], Figure],
) -> None:
    whole = pixels(draw(results()))
    assert np.array_equal(whole, pixels(draw(results())))
    assert not np.array_equal(pixels(draw(Results({}))), whole)


def test_infinite_errors_are_triangles() -> None:
    figure = error_figure(results({BY_EPISODE: ["infinite"]}, OURS.full_ab), TASKS)
    marks = [line for axes in figure.axes for line in axes.lines if line.get_marker() == "^"]
    assert len(marks) == 2 * len(TASKS)


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


def test_a_figure_is_written_as_a_picture(tmp_path: Path) -> None:
    picture = write_figure(tmp_path, "edges", "Edges", "caption", new_figure(1.0, 1.0))
    assert picture == Picture("Edges", "caption", "figures/edges.png")
    assert imread(tmp_path / picture.path).shape[:2] == (130, 130)


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


def test_text_of_numbers() -> None:
    assert with_range(SeedStatistic()) == "not known"
    assert with_range(SeedStatistic((1.0,)), "cm") == "1 cm"
    assert with_range(SeedStatistic((3.0, 1.0, math.inf)), "cm") == "3 cm (1 to not finite)"
    assert joined([]) == "" and joined(["a"]) == "a" and joined(["a", "b", "c"]) == "a, b and c"
