import os
import subprocess
import sys

import pytest

_CHILD = """
import os
from contactgraph.robot.loop.undisturbed import give_way
give_way(3)
print(os.sched_getscheduler(0) == os.SCHED_OTHER, os.nice(0))
"""


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="no real-time priorities here")
def test_a_process_begun_with_real_time_priority_gives_way():
    before = os.nice(0)

    def first() -> None:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))

    try:
        done = subprocess.run(
            [sys.executable, "-c", _CHILD], preexec_fn=first, capture_output=True, text=True
        )
    except subprocess.SubprocessError:
        pytest.skip("this system lets no process have real-time priority")
    assert done.stdout.split() == ["True", str(before + 3)], done.stderr
