"""Jobs of a study: run once, in dependency order, and again when their command changes."""

import json
import multiprocessing
from pathlib import Path

import pytest
from fake_worker import FakeWorker, Here, done

from contactgraph.data import read_trajectories
from contactgraph.parallel import Executor, LocalExecutor
from contactgraph_studies.execution import LocalJob, create_worker, execute
from contactgraph_studies.job import Job, JobRecords, in_dependency_order
from contactgraph_studies.runner import Failure, Progress, run_jobs


def make(output: str, *words: str, needs: tuple[Job, ...] = ()) -> Job:
    return Job(output, ("make", output, *words), "make", needs)


def run(
    folder: Path, jobs: list[Job], executor: Executor | None = None, version: str = "1"
) -> tuple[list[Failure], list[Progress]]:
    steps: list[Progress] = []
    records, create = JobRecords(folder, version), FakeWorker(folder.absolute()).create
    given = in_dependency_order(jobs), records, executor or Here(), create, steps.append
    return run_jobs(*given), steps


def test_finished_jobs_are_not_run_again(tmp_path: Path) -> None:
    data = make("deep/data", "x")
    jobs = [make("result", needs=(data,))]
    failures, steps = run(tmp_path, jobs)
    assert failures == []
    assert done(tmp_path) == ["make deep/data x", "make result"]
    assert (tmp_path / "deep" / "data").read_text() == "x"
    assert [(step.done, step.total) for step in steps] == [(1, 2), (2, 2)]
    assert steps[0].seconds_left == pytest.approx(0.25 / 2), "one more of the kind, two workers"
    assert steps[1].seconds_left == 0.0
    assert not list(tmp_path.rglob("*.log")), "only failures leave a log"
    record = json.loads((tmp_path / "result.made.json").read_text())
    assert (record["command"], record["finished"]) == ("contactgraph make result", True)
    assert run(tmp_path, jobs) == ([], [])
    assert done(tmp_path) == []


def test_missing_or_unfinished_outputs_are_made_again(tmp_path: Path) -> None:
    jobs = [make("a"), make("b")]
    run(tmp_path, jobs)
    done(tmp_path)
    (tmp_path / "a").unlink()
    run(tmp_path, jobs)
    assert done(tmp_path) == ["make a"]
    JobRecords(tmp_path, "1").begin(jobs[1])  # as a process would leave it that was killed
    run(tmp_path, jobs)
    assert done(tmp_path) == ["make b"]
    (tmp_path / "b.made.json").write_text("{")
    run(tmp_path, jobs)
    assert done(tmp_path) == ["make b"]


def test_another_command_or_version_is_run_again_with_all_that_needs_it(tmp_path: Path) -> None:
    def jobs_of(words: str) -> list[Job]:
        data = make("data", words)
        return [make("result", needs=(make("run", needs=(data,)),)), make("other")]

    run(tmp_path, jobs_of("old"))
    done(tmp_path)
    run(tmp_path, jobs_of("new"))
    assert done(tmp_path) == ["make data new", "make run", "make result"]
    run(tmp_path, jobs_of("new"), version="2")
    assert len(done(tmp_path)) == 4


def test_a_result_of_another_input_is_made_again_in_a_later_run(tmp_path: Path) -> None:
    run(tmp_path, [make("result", needs=(make("data", "old"),))])
    run(tmp_path, [make("data", "new")])
    done(tmp_path)
    run(tmp_path, [make("result", needs=(make("data", "new"),))])
    assert done(tmp_path) == ["make result"]


def test_an_input_that_is_gone_is_made_again_for_what_needs_it_alone(tmp_path: Path) -> None:
    data = make("data")
    first, second = make("first", needs=(data,)), make("second", needs=(data,))
    run(tmp_path, [first])
    done(tmp_path)
    (tmp_path / "data").unlink()
    failures, _ = run(tmp_path, [first])
    assert (failures, done(tmp_path)) == ([], [])
    run(tmp_path, [first, second])
    assert done(tmp_path) == ["make data", "make second"]


def test_a_study_goes_on_from_its_results_alone(tmp_path: Path) -> None:
    """The outputs themselves are not kept with a page; their times are."""
    data = make("data")
    jobs = [data, *(make(name, needs=(data,)) for name in ("first", "second"))]
    cells = [{"fingerprint": jobs[1].fingerprint, "values": {"error": 0.25}}]
    costs = {jobs[0].fingerprint: {"seconds": 3.5, "draws": 2}}
    stored = {"versions": {"contactgraph": "1"}, "cells": cells, "jobs": costs}
    (tmp_path / "results.json").write_text(json.dumps(stored))
    records = JobRecords(tmp_path, "1")
    records.restore(jobs, tmp_path / "results.json")
    assert json.loads((tmp_path / "first").read_text()) == {"error": 0.25}
    known = costs | {jobs[1].fingerprint: {"seconds": 0.0, "draws": 1}}
    assert (records.costs(jobs), records.redrawn(jobs)) == (known, {data.command: 1})
    run(tmp_path, jobs)
    assert done(tmp_path) == ["make data", "make second"]
    assert records.costs(jobs)[data.fingerprint] != costs[data.fingerprint], "made again"
    records.restore(jobs, tmp_path / "results.json")
    assert records.costs(jobs)[data.fingerprint] != costs[data.fingerprint], "older"
    other = tmp_path / "other"
    other.mkdir()
    (other / "results.json").write_text(json.dumps(stored))
    JobRecords(other, "2").restore(jobs, other / "results.json")
    assert [path.name for path in other.iterdir()] == ["results.json"], "another version"


def test_after_its_time_no_job_is_started(tmp_path: Path) -> None:
    given = Here(), FakeWorker(tmp_path).create, lambda progress: None
    assert run_jobs([make("late")], JobRecords(tmp_path, "1"), *given, seconds=0.0) == []
    assert done(tmp_path) == []


@pytest.mark.parametrize(
    ("verb", "executor", "reason"),
    [
        ("fail", Here(1), "exit code 2; contactgraph: it cannot be"),
        ("die", LocalExecutor(1), "its process died, exit code 9; it printed n"),
    ],
)
def test_a_failure_stops_only_the_jobs_that_need_it(
    tmp_path: Path, verb: str, executor: Executor, reason: str
) -> None:
    bad = Job("bad", (verb, "bad"), "bad")
    lost = make("lost", needs=(bad,))
    jobs = [bad, make("further", needs=(lost,)), make("good"), make("better")]
    failures, steps = run(tmp_path, jobs, executor)
    assert [failure.job.output for failure in failures] == ["bad", "lost", "further"]
    assert failures[0].reason.startswith(reason)
    assert failures[1].reason == "not started: it needs bad"
    assert failures[2].reason == "not started: it needs lost"
    assert (tmp_path / "good").exists() and (tmp_path / "better").exists()
    assert [step.failure is None for step in steps] == [False, True, True]
    assert steps[-1].done == steps[-1].total == 5
    done(tmp_path)
    run(tmp_path, jobs, executor)
    assert done(tmp_path) == [f"{verb} bad"], "tried again, and nothing else is"


def test_a_training_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    job = Job("run", ("half", "run"), "train", checkpoints="checkpoint-*")
    failures, _ = run(tmp_path, [job])
    assert len(failures) == 1
    assert run(tmp_path, [job])[0] == []
    assert done(tmp_path) == ["half run", "half run --resume"]
    # Begun by another command it starts from nothing.
    other = Job("run", ("half", "run", "x"), "train", checkpoints="checkpoint-*")
    run(tmp_path, [other])
    assert done(tmp_path) == ["half run x"]


@pytest.mark.parametrize(("alive", "draws"), [("1003", 2), ("never", 5)])
def test_a_dead_network_is_drawn_again_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, alive: str, draws: int
) -> None:
    monkeypatch.chdir(tmp_path)
    job = Job("run", ("train", "data", "--out", "run", "--seed", "3"), "train")
    tried: list[list[str]] = []

    def run_command(arguments: list[str], log: Path) -> int:
        tried.append(arguments)
        Path("run").mkdir()
        log.write_text("contactgraph: run: the network is dead: its messages are the same\n")
        return int(alive not in arguments)

    given = LocalJob((*job.arguments, "--resume"), tmp_path, tmp_path / "log")
    result = execute(given, run_command)
    assert (result.draws, result.exit_code) == (draws, int(alive == "never"))
    assert result.dead is (alive == "never")
    assert [each[-1] for each in tried] == ["--resume", *(f"{n}003" for n in range(1, draws))]
    records = JobRecords(tmp_path, "1")
    records.finish(job, 1.0, result.draws)
    assert records.redrawn([job]) == {job.command: draws - 1}
    tried.clear()
    assert execute(LocalJob(("evaluate", "run"), tmp_path, tmp_path / "log"), failing).draws == 1


def failing(arguments: list[str], log: Path) -> int:
    return 1


def test_a_training_that_has_dead_networks_alone_is_not_tried_again(tmp_path: Path) -> None:
    arguments = ("train", "data", "--out", "bad", "--seed", "3")
    bad, other = Job("bad", arguments, "train"), make("other")
    after = make("after", needs=(bad,))
    (tmp_path / "dead.txt").write_text("bad")
    failures, _ = run(tmp_path, [bad, after, other])
    assert sorted(done(tmp_path)) == [*["bad"] * 5, "make other"]
    dead = "exit code 2; contactgraph: the network is dead"
    assert failures == [Failure(bad, dead), Failure(after, "not started: it needs bad", False)]
    assert run(tmp_path, [bad, after])[0] == failures
    assert done(tmp_path) == [], "nothing is left to run"
    costs = JobRecords(tmp_path, "1").costs([bad])
    assert costs == {bad.fingerprint: {"seconds": 0.25, "draws": 5, "refused": dead}}
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    stored = {"versions": {"contactgraph": "1"}, "cells": [], "jobs": costs}
    (elsewhere / "results.json").write_text(json.dumps(stored))
    JobRecords(elsewhere, "1").restore([bad], elsewhere / "results.json")
    assert JobRecords(elsewhere, "1").refusal(bad) == dead
    assert JobRecords(elsewhere, "2").refusal(bad) is None


def test_several_at_a_time(tmp_path: Path) -> None:
    jobs = [make(f"job-{number}") for number in range(12)]
    failures, steps = run(tmp_path, jobs, Here(3))
    assert failures == []
    assert sorted(done(tmp_path)) == sorted(f"make job-{number}" for number in range(12))
    assert [step.done for step in steps] == list(range(1, 13))


def test_a_process_prefers_jobs_whose_programs_it_has(tmp_path: Path) -> None:
    jobs = [Job(f"{n}", ("make", f"{n}"), group="ab"[n % 2]) for n in range(60)]
    run(tmp_path, jobs, Here(1))
    first = [int(line.split()[1]) % 2 for line in done(tmp_path)]
    assert first == [0] * 30 + [1] * 30


def test_ctrl_c_ends_the_workers_and_the_next_run_continues(tmp_path: Path) -> None:
    jobs = [make("a"), make("b"), make("c")]

    def interrupted(progress: Progress) -> None:
        raise KeyboardInterrupt

    begin = FakeWorker(tmp_path).create
    with pytest.raises(KeyboardInterrupt):
        run_jobs(jobs, JobRecords(tmp_path, "1"), LocalExecutor(1), begin, interrupted)
    assert multiprocessing.active_children() == []
    assert done(tmp_path) == ["make a"]
    run(tmp_path, jobs)
    assert sorted(done(tmp_path)) == ["make b", "make c"]


def test_a_real_cell(tmp_path: Path) -> None:
    """One of our own commands, by the real worker on a core of its own."""
    arguments = ("collect", "pickup", "--episodes", "2", "--out", "cells/data.h5")
    job = Job("cells/data.h5", arguments, "collect")
    wrong = Job("cells/no.h5", ("collect", "pickup", "--episodes", "0", "--out", "no.h5"), "x")
    failures = run_jobs(
        [wrong, job], JobRecords(tmp_path, "1"), LocalExecutor(1), create_worker, lambda _: None
    )
    assert [failure.reason for failure in failures] == [
        "exit code 2; contactgraph: --episodes must be 1 to 100000, found 0"
    ]
    assert len(read_trajectories(tmp_path / "cells" / "data.h5")) == 2
