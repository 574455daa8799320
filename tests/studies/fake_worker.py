"""Work for tests: a worker that writes its arguments to its output, an executor without processes.

``make OUT WORDS…`` writes WORDS to OUT; ``both OUT`` writes OUT and OUT.more; ``join OUT IN…``
writes the contents of the files IN; ``fail OUT`` exits with 2 and a message; ``die OUT`` ends the
process; ``half OUT`` leaves a checkpoint and fails unless it resumes; ``wait OUT`` waits for the
file go.txt after it has written its process id and its parent's to begun.txt.
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from contactgraph.parallel import Outcome, Pool
from contactgraph_studies.execution import JobResult, LocalJob, RemoteJob, execute


@dataclass(frozen=True)
class FakeWorker:
    """Records its work in a folder."""

    diary: Path

    def create(self) -> Callable[[LocalJob | RemoteJob], JobResult]:
        return self.work

    def work(self, job: LocalJob | RemoteJob) -> JobResult:
        return replace(execute(job, self.perform), seconds=0.25)

    def perform(self, arguments: list[str], log: Path) -> int:
        if arguments[0] in ("collect", "train", "evaluate", "control"):
            return self.pretend(arguments, log)
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

    def pretend(self, arguments: list[str], log: Path) -> int:
        output = arguments[arguments.index("--json" if "--json" in arguments else "--out") + 1]
        with (self.diary / "done.txt").open("a") as done:
            done.write(f"{output}\n")
        for name, reason in (("fails", "it cannot be"), ("dead", "the network is dead")):
            fails = self.diary / f"{name}.txt"
            if fails.exists() and output in fails.read_text().split():
                log.write_text(f"first line\ncontactgraph: {reason}\n")
                return 2
        Path(output).write_text((self.diary / "values.json").read_text())
        return 0


def done(diary: Path) -> list[str]:
    """The command lines, or of a study's commands the outputs, since the last call."""
    path = diary / "done.txt"
    lines = path.read_text().splitlines() if path.exists() else []
    path.unlink(missing_ok=True)
    return lines


@dataclass
class Here:
    """An executor, and its pool, that work in this process."""

    workers: int = 2
    shares_files = True
    given: dict[int, Any] = field(default_factory=dict)

    @contextmanager
    def pool(self, initializer: Callable[[], Callable], items: int) -> Iterator[Pool]:
        self.work = initializer()
        yield self

    def idle(self) -> Sequence[int]:
        return [worker for worker in range(self.workers) if worker not in self.given]

    def submit(self, worker: int, item: Any) -> None:
        self.given[worker] = item

    def wait(self) -> Sequence[Outcome]:
        given, self.given = self.given, {}
        with chdir("."):  # work changes the folder
            return [Outcome(worker, item, self.work(item)) for worker, item in given.items()]
