"""Ctrl-C or a kill while several processes record leaves no process behind."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from contactgraph.parallel import usable_cores

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(len(usable_cores()) == 1, reason="with one core there is one process"),
]

SCRIPT = """
import signal
import sys
from contactgraph.cli.main import main

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main())
"""
"""As installed: every process imports it. It reacts to Ctrl-C even where a shell lets background
processes ignore it."""


@pytest.fixture
def collecting(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Records for minutes, at the head of a process group; there are others in it by now."""
    script = tmp_path / "contactgraph"
    script.write_text(SCRIPT)
    arguments = ["collect", "door", "--distractors", "10", "--episodes", "5000", "--out", "x.h5"]
    with subprocess.Popen(
        [sys.executable, str(script), *arguments],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            while len(members(process.pid)) < 3:
                assert process.poll() is None
                time.sleep(0.02)
            yield process
        finally:
            if members(process.pid):
                os.killpg(process.pid, signal.SIGKILL)
    left = [path for path in tmp_path.iterdir() if path != script]
    assert all(path.is_dir() and path.name.startswith("x.h5.unfinished-") for path in left)


def members(group: int) -> list[str]:
    """The processes of a group that have not ended."""
    listed = subprocess.run(["ps", "-A", "-o", "pgid=,stat="], capture_output=True, text=True)
    rows = [row.split() for row in listed.stdout.splitlines()]
    return [row[1] for row in rows if row[0] == str(group) and not row[1].startswith("Z")]


def gone(group: int) -> bool:
    until = time.monotonic() + 20.0
    while members(group) and time.monotonic() < until:
        time.sleep(0.05)
    return not members(group)


def test_ctrl_c_is_answered_by_one_and_ends_all(collecting: subprocess.Popen[str]) -> None:
    time.sleep(0.15)  # they have begun, and are at their imports
    os.killpg(collecting.pid, signal.SIGINT)  # as a terminal does
    _, said = collecting.communicate(timeout=30)
    assert collecting.returncode == 130
    assert said.splitlines()[-1] == "contactgraph: interrupted"
    assert "Traceback" not in said
    assert gone(collecting.pid)


def test_processes_end_with_one_that_is_killed(collecting: subprocess.Popen[str]) -> None:
    time.sleep(1.0)  # they are at work
    os.kill(collecting.pid, signal.SIGKILL)
    collecting.communicate(timeout=30)
    assert gone(collecting.pid)
