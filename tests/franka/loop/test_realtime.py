import os
import subprocess
import sys
import threading

import pytest

from contactgraph_franka.loop.realtime import realtime_priority

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


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="no real-time priorities here")
def test_a_process_begun_with_real_time_priority_gives_way():
    done = subprocess.run([sys.executable, "-c", _CHILD], capture_output=True, text=True)
    if done.stdout == "no priorities\n":
        pytest.skip("this system lets no process have real-time priority")
    assert done.stdout.split() == ["True", str(os.nice(0) + 3)], done.stderr


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="no real-time priorities here")
def test_all_threads_go_first_together_and_only_within():
    """One that waits for a core, holding Python's lock, would hold up those that go first."""
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
                pytest.skip("this system lets no process have real-time priority")
            assert os.sched_getscheduler(other[0]) == os.SCHED_FIFO
        assert os.sched_getscheduler(other[0]) == before
        assert os.sched_getscheduler(0) == before
    finally:
        ends.set()
        thread.join()
