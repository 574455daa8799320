"""Work that needs all of a machine: one unit at a time, each in a new process."""

import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from contactgraph.data import InvalidInputError
from contactgraph.parallel import LocalExecutor, map_in_order


def shout(connection) -> None:
    connection.send(os.getppid())


@dataclass(frozen=True)
class SentJob:
    refused: int = -1
    deadly: int = -1

    def begin(self):
        def work(index: int):
            if index == self.refused:
                raise InvalidInputError(f"job {index}: rejected")
            if index == self.deadly:
                os._exit(7)
            # A subprocess, which workers of other executors may not start.
            ours, theirs = multiprocessing.Pipe()
            child = multiprocessing.get_context("spawn").Process(target=shout, args=(theirs,))
            child.start()
            parent = ours.recv()
            child.join()
            return index, parent, os.getpid(), len(os.sched_getaffinity(0))

        return work


def test_every_unit_has_a_new_process_all_cores_and_children():
    answers = list(map_in_order(LocalExecutor(whole_machine=True), SentJob().begin, range(2)))
    assert [index for index, *_ in answers] == [0, 1]
    assert all(parent == process for _, parent, process, _ in answers)
    assert len({process for _, _, process, _ in answers}) == 2
    assert {cores for *_, cores in answers} == {len(os.sched_getaffinity(0))}
    assert multiprocessing.active_children() == []


@pytest.mark.slow
def test_no_process_outlives_the_owner():
    script = (
        "import os, sys, time\n"
        "from contactgraph.parallel import LocalExecutor\n"
        "def begin():\n"
        "    return lambda unit: (print(os.getpid(), flush=True), time.sleep(60))\n"
        "if __name__ == '__main__':\n"
        "    with LocalExecutor(whole_machine=True).pool(begin, 1) as pool:\n"
        "        pool.submit(0, 0)\n"
        "        pool.wait()\n"
    )
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "owner.py"
        path.write_text(script)
        owner = subprocess.Popen([sys.executable, path], stdout=subprocess.PIPE, text=True)
        assert owner.stdout is not None
        worker = int(owner.stdout.readline())
        owner.kill()
        owner.wait()
        owner.stdout.close()
    until = time.monotonic() + 10.0
    while Path(f"/proc/{worker}").exists():
        assert time.monotonic() < until, "the worker is still there"
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("job", "error", "said"),
    [
        (SentJob(refused=0), InvalidInputError, "^job 0: rejected$"),
        (SentJob(deadly=0), RuntimeError, "^0: its process died, exit code 7$"),
    ],
)
def test_errors_in_a_process_are_reported(job, error, said):
    with pytest.raises(error, match=said):
        list(map_in_order(LocalExecutor(whole_machine=True), job.begin, range(2)))
    assert multiprocessing.active_children() == []
