"""Every example runs as a user runs it and prints the expected result."""

import json
import os
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest

from contactgraph.train import FitResult

EXAMPLES = Path(__file__).parent.parent / "examples"

PRINTS = {
    "01_collect_and_train.py": "half a second ahead, with distractors",
    "02_own_data.py": "constant velocity",
    "03_control.py": "success",
    "04_contact_graph.py": "gripper - target",
    "05_own_task.py": "Fetch keeps the contract\nsuccess: 100%",
    "06_compose_a_model.py": "frozen_contact: ",
    "07_learn_cost.py": "new goals: 100 %",
    "extend_edge_feature.py": "approach at +1 m/s: feature +0.50",
    "extend_edge_friction.py": "friction slows the sliding",
    "extend_edge_type.py": "cm; 2 times less with a spring",
    "extend_environment.py": "the fixed start succeeds in 5 of 5 scenes",
    "extend_metric.py": "touches not predicted on time",
    "extend_planner_cem.py": "100 % of 3 episodes",
    "extend_planner_mppi.py": "100 % of 3 episodes",
    "extend_recurrent_cell.py": "gripper - target, with a leaky cell:",
    "extend_sensor_fault.py": "contact estimate by the sticking sensor and motion",
    "extend_task.py": "Line meets the task contract; the expert's success: True",
}
FAST = ("extend_task.py",)
"""Examples that neither train nor plan."""
WRITES = {
    "01_collect_and_train.py": "model.safetensors",
    "02_own_data.py": "balls.h5",
    "04_contact_graph.py": "contact_graph.png",
    "07_learn_cost.py": "cost.json",
}
CACHE_VERBS = ("reading", "writing")


def test_every_example_is_listed_here_and_numbered_in_order() -> None:
    names = sorted(path.name for path in EXAMPLES.glob("*.py"))
    assert names == sorted(PRINTS)
    numbers = [name[:2] for name in names if not name.startswith("extend_")]
    assert numbers == [f"{n:02d}" for n in range(1, len(numbers) + 1)]


def cases() -> list[object]:
    slow = pytest.mark.slow
    return [pytest.param(name, marks=[] if name in FAST else slow) for name in sorted(PRINTS)]


@pytest.mark.parametrize("name", cases())
def test_an_example_runs(name: str, tmp_path: Path) -> None:
    target, elsewhere = tmp_path / "target", tmp_path / "elsewhere"
    target.mkdir()
    elsewhere.mkdir()
    arguments = [str(target)] if name in WRITES else []
    # Half a cached program, left by a killed process, is compiled again with a warning.
    warnings = ["error", *(f"ignore:Error {verb} persistent:UserWarning" for verb in CACHE_VERBS)]
    done = subprocess.run(
        [sys.executable, *(f"-W{each}" for each in warnings), str(EXAMPLES / name), *arguments],
        cwd=elsewhere,
        env={**os.environ, "TMPDIR": str(elsewhere), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert PRINTS[name] in done.stdout
    assert [path.name for path in target.iterdir()] == ([WRITES[name]] if name in WRITES else [])
    assert list(elsewhere.iterdir()) == [], "an example writes only to the given folder"


@pytest.mark.parametrize("name", sorted(PRINTS))
def test_an_example_reads_like_a_page(name: str) -> None:
    lines = (EXAMPLES / name).read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 75
    assert lines[0].startswith('"""')
    assert f"Usage: python examples/{name}" in "\n".join(lines[:6])


def notebook_cells() -> list[str]:
    """The code of the notebook's cells, without the commands to its own program."""
    notebook = json.loads((EXAMPLES / "tour.ipynb").read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    cells = [each for each in notebook["cells"] if each["cell_type"] == "code"]
    assert not any(each["outputs"] for each in cells), "a notebook is stored without outputs"
    return ["".join(x for x in each["source"] if not x.startswith("%")) for each in cells]


def test_the_notebook_is_python_of_names_that_exist() -> None:
    first, *others = notebook_cells()
    exec(first, {})
    for cell in others:
        compile(cell, "tour.ipynb", "exec")


@pytest.mark.slow
def test_the_notebook_runs(capsys: pytest.CaptureFixture[str]) -> None:
    matplotlib.use("agg")
    names: dict[str, object] = {"__name__": "__main__"}
    for number, cell in enumerate(notebook_cells(), start=1):
        exec(compile(cell, f"tour.ipynb, code cell {number}", "exec"), names)
    said = capsys.readouterr().out
    assert "success: 100%" in said
    assert "step 120: held-out error" in said
    result = names["result"]
    assert isinstance(result, FitResult) and result.is_better
