"""Real-time priority of the loop's threads, and normal priority of child processes."""

import os
import subprocess
import sys
import threading

import pytest

from contactgraph_franka.loop.realtime import realtime_priority

needs_priorities = pytest.mark.skipif(
    not hasattr(os, "sched_setscheduler"), reason="no real-time priorities on this system"
)

_CHILD = """
import os
from contactgraph_franka.loop.realtime import set_nice
try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
except OSError:
    print("no priorities")
else:
    set_nice(3)
    print(os.sched_getscheduler(0) == os.SCHED_OTHER, os.nice(0))
"""


@needs_priorities
@pytest.mark.slow
def test_set_nice_ends_inherited_real_time_priority() -> None:
    done = subprocess.run([sys.executable, "-c", _CHILD], capture_output=True, text=True)
    if done.stdout == "no priorities\n":
        pytest.skip("this system permits no real-time priority")
    assert done.stdout.split() == ["True", str(os.nice(0) + 3)], done.stderr


@needs_priorities
def test_all_threads_have_real_time_priority_within() -> None:
    """A thread of normal priority that holds Python's lock would delay the others."""
    ends, begun, other = threading.Event(), threading.Event(), []

    def work() -> None:
        other.append(threading.get_native_id())
        begun.set()
        ends.wait()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        begun.wait()
        before = os.sched_getscheduler(other[0])
        with realtime_priority():
            if os.sched_getscheduler(0) != os.SCHED_FIFO:
                pytest.skip("this system permits no real-time priority")
            assert os.sched_getscheduler(other[0]) == os.SCHED_FIFO
        assert os.sched_getscheduler(other[0]) == before
        assert os.sched_getscheduler(0) == before
    finally:
        ends.set()
        thread.join()
