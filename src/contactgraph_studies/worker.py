"""What a process does that makes the cells of a study: command lines, one after the other."""

import os
import sys
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

from contactgraph.cli.main import run
from contactgraph_studies.errand import CarriedErrand, Ended, Errand, carry_out


def begin() -> Callable[[Errand | CarriedErrand], Ended]:
    """The work."""
    return partial(carry_out, execute=execute)


def execute(arguments: list[str], log: Path) -> int:
    """Run a command with both outputs in the log, those of libraries in C included."""
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    try:
        return run(arguments)
    except Exception:
        # Said here, where a fault of one command must not end those that come after it.
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
