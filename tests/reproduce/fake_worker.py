"""A worker for tests: answers as the real one does, and writes what it was told to its output.

``make OUT WORDS…`` writes WORDS to OUT; ``fail OUT`` exits with 2 and says why; ``die OUT`` takes
the whole process with it; ``half OUT`` leaves a checkpoint and fails, unless it resumes.
"""

import json
import os
import sys
from pathlib import Path


def perform(arguments: list[str], log: Path) -> int:
    verb, output = arguments[0], Path(arguments[1])
    with Path("done.txt").open("a") as done:
        done.write(" ".join(arguments) + "\n")
    if verb == "die":
        os._exit(9)
    if verb == "fail":
        log.write_text("first line\ncontactgraph: it cannot be\n\n")
        return 2
    if verb == "half":
        output.mkdir(exist_ok=True)
        (output / "checkpoint-1").write_text("")
        return 0 if "--resume" in arguments else 130
    output.write_text(" ".join(arguments[2:]))
    return 0


with Path("started.txt").open("a") as started:
    started.write("started\n")
for line in sys.stdin:
    told = json.loads(line)
    code = perform(told["arguments"], Path(told["log"]))
    print(json.dumps({"code": code, "seconds": 0.25}), flush=True)
