"""Work shared out to processes: in order, with every mistake told, and nobody left behind."""

import multiprocessing
import os
import subprocess
import sys
import time
from dataclasses import dataclass

import pytest

from contactgraph.data import InvalidInputError
from contactgraph.tasks.processes import shared_out


@dataclass(frozen=True)
class Errand:
    """Work that a process can be sent."""

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
                raise InvalidInputError(f"errand {index}: nobody is in")
            if index == self.broken:
                raise KeyError("spoon")
            if index == self.deadly:
                os._exit(7)
            return index, os.getpid(), begun

        return work


def test_answers_come_in_order_from_processes_that_begin_once():
    answers = list(shared_out(Errand().begin, range(2, 8), 2))
    assert [index for index, _, _ in answers] == list(range(2, 8))
    begun = {(process, begun) for _, process, begun in answers}
    assert len(begun) == len(dict(begun)) and os.getpid() not in dict(begun)
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize(
    ("errand", "error", "said"),
    [
        (Errand(refused=3), InvalidInputError, "^errand 3: nobody is in$"),
        (Errand(broken=3), RuntimeError, "(?s)Traceback.*in work.*KeyError: 'spoon'"),
        (Errand(deadly=3), RuntimeError, "a process that shared the work has died, exit code 7"),
    ],
)
def test_what_goes_wrong_in_a_process_is_told(errand, error, said):
    with pytest.raises(error, match=said):
        list(shared_out(errand.begin, range(8), 2))
    assert multiprocessing.active_children() == []


def test_processes_end_with_whoever_wants_no_more():
    answers = shared_out(Errand(endless=1).begin, range(8), 2)
    next(answers)
    assert len(multiprocessing.active_children()) == 2
    answers.close()
    assert multiprocessing.active_children() == []


UNGUARDED = """
import functools, sys
from contactgraph.tasks.processes import shared_out

def begin(ballast):
    return str

print(list(shared_out(functools.partial(begin, "x" * int(sys.argv[1])), range(2), 1)))
"""


@pytest.mark.parametrize("ballast", ["1", "1000000"])
def test_a_script_that_is_not_guarded_ends_and_says_why(tmp_path, ballast):
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    told = subprocess.run(
        [sys.executable, str(script), ballast], capture_output=True, text=True, timeout=60
    )
    assert told.returncode == 1 and told.stdout == ""
    assert "RuntimeError: a process that" in told.stderr.splitlines()[-1]
    assert "if __name__ == '__main__':" in told.stderr
