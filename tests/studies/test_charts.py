"""Charts from made-up numbers: drawn whatever is missing, and the same each time."""

from collections.abc import Callable
from pathlib import Path

import pytest
from made_up import AMOUNTS, results
from matplotlib.figure import Figure as Chart

from contactgraph_studies.chart import svg, write_chart
from contactgraph_studies.declared import FULL_AB, TASKS
from contactgraph_studies.error_charts import edge_chart, error_chart, fault_chart, sample_chart
from contactgraph_studies.results import Results
from contactgraph_studies.study_table import rows

CHARTS: list[Callable[[Results], Chart]] = [
    lambda found: error_chart(rows(found, TASKS, AMOUNTS), TASKS),
    lambda found: edge_chart(found, TASKS),
    lambda found: fault_chart(found, TASKS),
    lambda found: sample_chart(found, TASKS, AMOUNTS),
]


@pytest.mark.parametrize("draw", CHARTS)
def test_charts_are_drawn_whatever_is_missing(draw: Callable[[Results], Chart]) -> None:
    whole = svg(draw(results()))
    assert whole == svg(draw(results()))
    assert svg(draw(Results({}))) != whole


def test_what_is_not_finite_is_hatched() -> None:
    found = results({"n_step_rmse_planned_m": None}, FULL_AB)
    made = error_chart(rows(found, TASKS, AMOUNTS), TASKS)
    hatched = [bar for axes in made.axes for bar in axes.patches if bar.get_hatch()]
    assert len(hatched) == 2 * len(TASKS)


def test_both_files_are_written(tmp_path: Path) -> None:
    write_chart(tmp_path / "figures", "edges", CHARTS[1](results()))
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == [
        "edges.png",
        "edges.svg",
    ]
