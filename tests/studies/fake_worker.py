"""A worker for tests: answers as the real one does, and writes what it was told to its output.

``make OUT WORDS…`` writes WORDS to OUT; ``both OUT`` writes OUT and OUT.more; ``join OUT IN…``
writes what the files IN hold; ``fail OUT`` exits with 2 and says why; ``die OUT`` takes the whole
process with it; ``half OUT`` leaves a checkpoint and fails, unless it resumes; ``wait OUT`` waits
for the file go.txt, having told in begun.txt who it is, and whose child.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from contactgraph_studies.errand import CarriedErrand, Ended, Errand, carry_out


@dataclass(frozen=True)
class FakeWorker:
    """Tells in a folder what was done."""

    diary: Path

    def begin(self) -> Callable[[Errand | CarriedErrand], Ended]:
        with (self.diary / "started.txt").open("a") as started:
            started.write("started\n")
        return self.work

    def work(self, errand: Errand | CarriedErrand) -> Ended:
        return replace(carry_out(errand, self.perform), seconds=0.25)

    def perform(self, arguments: list[str], log: Path) -> int:
        verb, output, *words = arguments
        with (self.diary / "done.txt").open("a") as done:
            done.write(" ".join(arguments) + "\n")
        match verb:
            case "die":
                os._exit(9)
            case "fail":
                log.write_text("first line\ncontactgraph: it cannot be\n\n")
                return 2
            case "half":
                Path(output).mkdir(exist_ok=True)
                (Path(output) / "checkpoint-1").write_text("")
                return 0 if "--resume" in arguments else 130
            case "both":
                Path(f"{output}.more").write_text("more")
            case "join":
                words = [Path(word).read_text() for word in words]
            case "wait":
                with (self.diary / "begun.txt").open("a") as begun:
                    begun.write(f"{os.getppid()} {os.getpid()}\n")
                until = time.monotonic() + 60.0
                while not (self.diary / "go.txt").exists() and time.monotonic() < until:
                    time.sleep(0.02)
        Path(output).write_text(" ".join(words))
        return 0
