"""A process that carries out command lines, so that one start serves many.

Told on standard input, one JSON object a line: ``{"arguments": ["collect", …], "log": FILE}``.
Answers on standard output: ``{"code": 0, "seconds": 1.5}``, with the command's exit code. What the
command prints goes to the log. Ends where its input ends.
"""

import json
import os
import sys
import time
import traceback
from pathlib import Path
from typing import TextIO


def main() -> None:
    """Serve until standard input ends. The first argument, if any, is the core to stay on."""
    if len(sys.argv) > 1 and hasattr(os, "sched_setaffinity"):
        # Before JAX is imported: it makes as many threads as it sees cores.
        os.sched_setaffinity(0, {int(sys.argv[1])})
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        told = json.loads(line)
        began = time.perf_counter()
        with Path(told["log"]).open("w") as log:
            code = _logged(told["arguments"], log)
        answer = {"code": code, "seconds": time.perf_counter() - began}
        print(json.dumps(answer), file=answers, flush=True)


def _logged(arguments: list[str], log: TextIO) -> int:
    """Run with both outputs in the log, those of libraries in C included."""
    from contactgraph.cli import run

    os.dup2(log.fileno(), 1)
    os.dup2(log.fileno(), 2)
    try:
        return run(arguments)
    except Exception:
        # Said here, where a fault of one command must not end those that come after it.
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


if __name__ == "__main__":
    main()
