"""Every example runs as a user runs it and prints the expected result."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"

PRINTS = {
    "01_collect_and_train.py": "half a second ahead, with distractors",
    "02_own_data.py": "constant velocity",
    "03_control.py": "success",
    "04_contact_graph.py": "gripper - target",
    "05_own_task.py": "Fetch keeps the contract\nsuccess: 100%",
    "06_compose_a_model.py": "frozen_contact: ",
    "07_learn_cost.py": "new goals: 100 %",
    "08_two_kinds_of_bonds.py": "type 2 is the rigid bond, 3 the soft one: right in 9",
    "extend_edge_feature.py": "approach at +1 m/s: feature +0.50",
    "extend_edge_friction.py": "friction slows the sliding",
    "extend_environment.py": "the fixed start succeeds in 5 of 5 scenes",
    "extend_metric.py": "touches not predicted on time",
    "extend_planner_mppi.py": "nearer",
    "extend_recurrent_cell.py": "gripper - target, with a leaky cell:",
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
