"""Cells of a study: made once, in order of need, and again when their command changes."""

import json
import multiprocessing
from pathlib import Path

import pytest
from fake_worker import FakeWorker

from contactgraph.parallel import LocalExecutor
from contactgraph_studies import worker
from contactgraph_studies.cell import Cell, in_order
from contactgraph_studies.record import Records
from contactgraph_studies.runner import Failure, Standing, run_cells


def make(output: str, *words: str, needs: tuple[Cell, ...] = ()) -> Cell:
    return Cell(output, ("make", output, *words), "make", needs)


def run(
    folder: Path, cells: list[Cell], workers: int = 2, version: str = "1"
) -> tuple[list[Failure], list[Standing]]:
    steps: list[Standing] = []
    records = Records(folder, version)
    executor, begin = LocalExecutor(workers), FakeWorker(folder.absolute()).begin
    return run_cells(in_order(cells), records, executor, begin, steps.append), steps


def done(folder: Path) -> list[str]:
    """The command lines that were carried out since the last call."""
    path = folder / "done.txt"
    lines = path.read_text().splitlines() if path.exists() else []
    path.unlink(missing_ok=True)
    return lines


def test_cells_come_behind_what_they_need() -> None:
    data = make("data")
    run_ = make("run", needs=(data,))
    assert [cell.output for cell in in_order([make("b", needs=(run_, data)), run_, data])] == [
        "data",
        "run",
        "b",
    ]


def test_what_is_done_is_not_done_again(tmp_path: Path) -> None:
    data = make("deep/data", "x")
    cells = [make("result", needs=(data,))]
    failures, steps = run(tmp_path, cells)
    assert failures == []
    assert done(tmp_path) == ["make deep/data x", "make result"]
    assert (tmp_path / "deep" / "data").read_text() == "x"
    assert [(step.done, step.total) for step in steps] == [(1, 2), (2, 2)]
    assert steps[0].seconds_left == pytest.approx(0.25 / 2), "one more of the kind, two workers"
    assert steps[1].seconds_left == 0.0
    assert not list(tmp_path.rglob("*.log")), "only failures leave what they said"
    record = json.loads((tmp_path / "result.made.json").read_text())
    assert (record["command"], record["finished"]) == ("contactgraph make result", True)
    assert run(tmp_path, cells) == ([], [])
    assert done(tmp_path) == []


def test_what_is_missing_or_begun_is_done_again(tmp_path: Path) -> None:
    cells = [make("a"), make("b")]
    run(tmp_path, cells)
    done(tmp_path)
    (tmp_path / "a").unlink()
    run(tmp_path, cells)
    assert done(tmp_path) == ["make a"]
    Records(tmp_path, "1").begin(cells[1])  # as a process would leave it that was killed
    run(tmp_path, cells)
    assert done(tmp_path) == ["make b"]
    (tmp_path / "b.made.json").write_text("{")
    run(tmp_path, cells)
    assert done(tmp_path) == ["make b"]


def test_another_command_or_version_is_done_anew_with_all_that_rests_on_it(tmp_path: Path) -> None:
    def cells(words: str) -> list[Cell]:
        data = make("data", words)
        return [make("result", needs=(make("run", needs=(data,)),)), make("other")]

    run(tmp_path, cells("old"))
    done(tmp_path)
    run(tmp_path, cells("new"))
    assert done(tmp_path) == ["make data new", "make run", "make result"]
    run(tmp_path, cells("new"), version="2")
    assert len(done(tmp_path)) == 4


def test_an_input_made_anew_makes_its_results_anew(tmp_path: Path) -> None:
    data = make("data")
    run(tmp_path, [make("result", needs=(data,))])
    done(tmp_path)
    (tmp_path / "data").unlink()
    run(tmp_path, [make("result", needs=(data,))])
    assert done(tmp_path) == ["make data", "make result"]


@pytest.mark.parametrize(
    ("verb", "reason"),
    [
        ("fail", "exit code 2; contactgraph: it cannot be"),
        ("die", "its process died, exit code 9; it said noth"),
    ],
)
def test_a_failure_takes_only_what_needs_it(tmp_path: Path, verb: str, reason: str) -> None:
    bad = Cell("bad", (verb, "bad"), "bad")
    lost = make("lost", needs=(bad,))
    cells = [bad, make("further", needs=(lost,)), make("good"), make("better")]
    failures, steps = run(tmp_path, cells, workers=1)
    assert [failure.cell.output for failure in failures] == ["bad", "lost", "further"]
    assert failures[0].reason.startswith(reason)
    assert failures[1].reason == "not begun: it needs bad"
    assert failures[2].reason == "not begun: it needs lost"
    assert (tmp_path / "good").exists() and (tmp_path / "better").exists()
    assert [step.failure is None for step in steps] == [False, True, True]
    assert steps[-1].done == steps[-1].total == 5
    done(tmp_path)
    run(tmp_path, cells)
    assert done(tmp_path) == [f"{verb} bad"], "tried again, and nothing else is"


def test_a_training_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    cell = Cell("run", ("half", "run"), "train", checkpoints="checkpoint-*")
    failures, _ = run(tmp_path, [cell])
    assert len(failures) == 1
    assert run(tmp_path, [cell])[0] == []
    assert done(tmp_path) == ["half run", "half run --resume"]
    # Begun by another command it starts from nothing.
    other = Cell("run", ("half", "run", "x"), "train", checkpoints="checkpoint-*")
    run(tmp_path, [other])
    assert done(tmp_path) == ["half run x"]


def test_several_at_a_time(tmp_path: Path) -> None:
    cells = [make(f"cell-{number}") for number in range(12)]
    failures, steps = run(tmp_path, cells, workers=3)
    assert failures == []
    assert sorted(done(tmp_path)) == sorted(f"make cell-{number}" for number in range(12))
    assert [step.done for step in steps] == list(range(1, 13))


def test_a_process_goes_on_with_what_it_has_compiled_and_is_not_kept_for_ever(
    tmp_path: Path,
) -> None:
    cells = [Cell(f"{n}", ("make", f"{n}"), kind="ab"[n % 2]) for n in range(60)]
    run(tmp_path, cells, workers=1)
    first = [int(line.split()[1]) % 2 for line in done(tmp_path)]
    assert first == [0] * 25 + [1] * 25 + [0] * 5 + [1] * 5
    assert (tmp_path / "started.txt").read_text().count("started") == 3


def test_interrupted_it_ends_its_workers_and_goes_on_later(tmp_path: Path) -> None:
    cells = [make("a"), make("b"), make("c")]

    def interrupted(standing: Standing) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_cells(
            cells,
            Records(tmp_path, "1"),
            LocalExecutor(1),
            FakeWorker(tmp_path).begin,
            interrupted,
        )
    assert multiprocessing.active_children() == []
    assert done(tmp_path) == ["make a"]
    run(tmp_path, cells)
    assert sorted(done(tmp_path)) == ["make b", "make c"]


def test_a_real_cell(tmp_path: Path) -> None:
    """One of our own commands, by the real worker on a core of its own."""
    arguments = ("collect", "pickup", "--episodes", "2", "--out", "cells/data.h5")
    cell = Cell("cells/data.h5", arguments, "collect")
    wrong = Cell("cells/no.h5", ("collect", "pickup", "--episodes", "0", "--out", "no.h5"), "x")
    failures = run_cells(
        [wrong, cell], Records(tmp_path, "1"), LocalExecutor(1), worker.begin, lambda _: None
    )
    assert [failure.reason for failure in failures] == [
        "exit code 2; contactgraph: --episodes must be 1 to 100000, found 0"
    ]
    from contactgraph.data import read_trajectories

    assert len(read_trajectories(tmp_path / "cells" / "data.h5")) == 2
