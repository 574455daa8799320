"""Parallel jobs: ordered results, reported errors, and no process left."""

import multiprocessing
import os
import subprocess
import sys
import time
from dataclasses import dataclass

import pytest

from contactgraph.data import InvalidInputError
from contactgraph.parallel import LocalExecutor, map_in_order, usable_cores


@dataclass(frozen=True)
class SentJob:
    """A job that can be sent to a process."""

    refused: int = -1
    broken: int = -1
    deadly: int = -1
    endless: int = -1

    def begin(self):
        begun = time.perf_counter_ns()

        def work(index: int):
            # Late ones are quick, so that answers come in another order than they are wanted in.
            time.sleep(600.0 if index == self.endless else 0.02 * (8 - index))
            if index == self.refused:
                raise InvalidInputError(f"job {index}: rejected")
            if index == self.broken:
                raise KeyError("spoon")
            if index == self.deadly:
                os._exit(7)
            return index, os.getpid(), begun

        return work


def test_answers_come_in_order_from_processes_that_begin_once():
    answers = list(map_in_order(LocalExecutor(2), SentJob().begin, range(2, 8)))
    assert [index for index, _, _ in answers] == list(range(2, 8))
    begun = {(process, begun) for _, process, begun in answers}
    assert len(begun) == len(dict(begun)) and os.getpid() not in dict(begun)
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize(
    ("job", "error", "said"),
    [
        (SentJob(refused=3), InvalidInputError, "^job 3: rejected$"),
        (SentJob(broken=3), RuntimeError, "(?s)Traceback.*in work.*KeyError: 'spoon'"),
        (SentJob(deadly=3), RuntimeError, "^3: its process died, exit code 7$"),
    ],
)
def test_errors_in_a_process_are_reported(job, error, said):
    with pytest.raises(error, match=said):
        list(map_in_order(LocalExecutor(2), job.begin, range(8)))
    assert multiprocessing.active_children() == []


class Place:
    """Core and process id of the work."""

    def begin(self):
        return lambda unit: (os.getpid(), usable_cores(), os.environ["NPROC"])


def test_each_process_stays_on_a_core():
    with LocalExecutor(1).pool(Place().begin, 3) as pool:
        processes = set()
        for unit in range(3):
            pool.submit(0, unit)
            (outcome,) = pool.wait()
            process, cores, most = outcome.result
            assert (outcome.item, len(cores), most) == (unit, 1, "1")
            processes.add(process)
    assert len(processes) == 1


def test_a_dead_process_is_reported_and_replaced():
    with LocalExecutor(2).pool(SentJob(deadly=3).begin, 8) as pool:
        for worker, unit in zip(pool.idle(), (3, 7), strict=True):
            pool.submit(worker, unit)
        outcomes = []
        while len(outcomes) < 2:
            outcomes += pool.wait()
        (lost,) = [outcome for outcome in outcomes if outcome.result is None]
        assert (lost.item, lost.lost) == (3, "its process died, exit code 7")
        (fresh,) = [worker for worker in pool.idle() if worker > 1]
        pool.submit(fresh, 6)
        assert pool.wait()[0].result[0] == 6


def test_there_must_be_a_process():
    with pytest.raises(InvalidInputError, match="processes must be at least 1, found 0"):
        LocalExecutor(0)


def test_the_number_of_cores_is_that_of_nproc(monkeypatch):
    every = usable_cores()
    monkeypatch.setenv("NPROC", "1")
    assert usable_cores() == every[:1]
    monkeypatch.setenv("NPROC", "many")
    assert usable_cores() == every


def test_processes_end_with_their_consumer():
    answers = map_in_order(LocalExecutor(2), SentJob(endless=1).begin, range(8))
    next(answers)
    assert len(multiprocessing.active_children()) == 2
    answers.close()
    assert multiprocessing.active_children() == []


UNGUARDED = """
import functools, sys
from contactgraph.parallel import LocalExecutor, map_in_order

def begin(ballast):
    return str

work = functools.partial(begin, "x" * int(sys.argv[1]))
print(list(map_in_order(LocalExecutor(1), work, range(2))))
"""


@pytest.mark.slow
@pytest.mark.parametrize("ballast", ["1", "1000000"])
def test_an_unguarded_script_ends_with_the_reason(tmp_path, ballast):
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    finished = subprocess.run(
        [sys.executable, str(script), ballast], capture_output=True, text=True, timeout=60
    )
    assert finished.returncode == 1 and finished.stdout == ""
    assert "RuntimeError: 0: its process died" in finished.stderr.splitlines()[-1]
    assert "if __name__ == '__main__':" in finished.stderr
