"""Tables, targets, charts and the page, from made-up numbers."""

import csv
import io

import pytest
from made_up import AMOUNTS, by_the_paper, results

from contactgraph.viz.number_table import csv_numbers, markdown_numbers
from contactgraph_studies.claims import claims
from contactgraph_studies.declared import DOOR, FRANKA, FULL_AB, GIM_TEMP, MODELS, PICKUP, TASKS
from contactgraph_studies.findings import Findings, Picture
from contactgraph_studies.plan_cells import Source, Where
from contactgraph_studies.results import Figure, Reading, Results
from contactgraph_studies.study_page import StudyPage, study_page
from contactgraph_studies.study_table import csv_rows, markdown_rows, page_table, rows
from contactgraph_studies.targets import targets
from contactgraph_studies.words import joined, short, with_range

ERROR = "n_step_rmse_planned_m"


def test_a_row_a_task_condition_and_model() -> None:
    table = rows(results(), TASKS, AMOUNTS)
    assert len(table) == 3 * 2 * len(MODELS), "the extra condition is left out"
    first = table[0]
    assert (first.task, first.condition, first.model) == ("pickup", PICKUP.as_trained, "GIM-Temp")
    assert first.planned.values == (0.8, 0.8, 0.8)
    assert first.success is not None and (first.success.successes, first.success.episodes) == (
        60,
        60,
    )
    assert str(first.success) == "100 % of 60 (94 to 100)"
    assert first.commands[0].startswith("contactgraph control cells/pickup/seed-0/gim-temp-40/run ")
    free = next(row for row in table if row.model == FULL_AB.name)
    assert str(free.success) == "10 % of 60 (5 to 20)"
    assert free.success_every_step is None


def test_tables_say_the_same_to_people_and_programs() -> None:
    table = rows(results({ERROR: None}, FULL_AB), TASKS, AMOUNTS)
    markdown = markdown_rows(table).splitlines()
    assert len(markdown) == 2 + len(table)
    assert markdown[2].startswith("| pickup | as trained | GIM-Temp | 0.8 (0.8 to 0.8) | 1.6 ")
    assert "| Full-AB | not finite (not finite to not finite) |" in markdown[6]
    read = list(csv.DictReader(io.StringIO(csv_rows(table))))
    assert len(read) == len(table)
    assert (read[0]["planned_cm_median"], read[0]["seeds"]) == ("0.8", "3")
    assert read[0]["command_open_loop"].startswith("contactgraph evaluate ")
    assert read[4]["planned_cm_median"] == "inf"
    empty = csv_rows(rows(Results({}), TASKS, AMOUNTS))
    assert next(csv.DictReader(io.StringIO(empty)))["planned_cm_median"] == ""


def test_an_error_of_moving_bodies_is_not_known_where_nothing_moves() -> None:
    moving = "n_step_rmse_planned_moving_m"
    still = rows(results({moving: None}, FULL_AB), TASKS, AMOUNTS)[4]
    assert not still.planned_moving.known
    wild = rows(results({moving: None, ERROR: None}, FULL_AB), TASKS, AMOUNTS)[4]
    assert wild.planned_moving.median == float("inf")


def test_targets_are_judged_by_the_median_over_seeds() -> None:
    where = Where(Source.planned, "door", GIM_TEMP.name, DOOR.hardest.name)
    base = by_the_paper(where)
    readings = [
        Reading(seed, {**base, ERROR: error}, "contactgraph control")
        for seed, error in enumerate((0.001, 0.011, 0.05))
    ]
    numbers = {
        number.name: number for number in targets(Results({where: readings}), [DOOR], (0, 1, 2))
    }
    error = numbers["door, 10 more doors: N-step error, planned against executed"]
    assert error.value == pytest.approx(1.1)
    assert error.interval == pytest.approx((0.1, 5.0))
    assert (error.at_least, error.aim, error.reached) == (1.2, 0.3, True)
    assert numbers["door, 10 more doors: edge F1, the same"].reached is True
    assert numbers["door, 10 more doors: success"].reached is None, "not measured"
    text = markdown_numbers(list(numbers.values()))
    assert "planned against executed | 1.1 cm (0.1 to 5) | 1.2 | 0.3 | yes |" in text
    assert "10 more doors: success | not known | 95 | 100 |  |" in text
    arm = {number.name: number for number in targets(results(), [FRANKA], (0, 1, 2))}
    assert arm["franka, 5 distractors: success"].at_least == 90.0
    missed = targets(results({ERROR: 0.02}, GIM_TEMP), TASKS, (0,))
    assert "| **no** |" in markdown_numbers(missed)
    read = list(csv.DictReader(io.StringIO(csv_numbers(missed))))
    assert len(read) == len(missed) == 3 * 2 * 4
    assert (read[0]["value"], read[0]["reached"]) == ("2.0", "False")


def test_the_page_says_verdicts_first_and_loads_nothing() -> None:
    found = Findings(
        title="Study <1>",
        summary="in short",
        claims=claims(results({ERROR: 0.02}), TASKS, AMOUNTS),
        asked="What it must reach",
        targets=targets(results(), TASKS, (0, 1, 2)),
        tables=[page_table(rows(results(), TASKS, AMOUNTS))],
        table_markdown="",
        table_csv="",
        figures=[Picture("Errors", "cm", b"<svg/>", "svg+xml")],
        scenes=[],
        amounts={},
        readings=[],
    )
    failures = [("contactgraph x", "exit code 2; <b>")]
    commands = ["contactgraph reproduce all"]
    page = study_page(StudyPage(found, failures, commands, {"jax": "1"}, "today"))
    assert page.count("<td>pickup</td><td>as trained</td><td>GIM-Temp</td>") == 1
    assert "Study &lt;1&gt;" in page and "exit code 2; &lt;b&gt;" in page
    assert page.index('class="verdict missed">does not hold') < page.index('id="figures"')
    assert page.index('class="verdict met">holds') < page.index('id="figures"')
    assert "data:image/svg+xml;base64,PHN2Zy8+" in page
    assert "default-src 'none'" in page
    assert "http://" not in page and "https://" not in page
    assert "$" not in page, "a place in the template that nothing fills"


def test_numbers_in_words() -> None:
    assert [short(value) for value in (0.0, 0.01234, 12.345, 1234.5, 1e-6, 2.5e7)] == [
        "0",
        "0.0123",
        "12.3",
        "1234",
        "1e-06",
        "2.5e+07",
    ]
    assert with_range(Figure(())) == "not known"
    assert with_range(Figure((1.0,)), "cm") == "1 cm"
    assert with_range(Figure((3.0, 1.0, float("inf"))), "cm") == "3 cm (1 to not finite)"
    assert joined([]) == "" and joined(["a"]) == "a" and joined(["a", "b", "c"]) == "a, b and c"
