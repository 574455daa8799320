"""A worker process as its owner sees it: it is given cells one after the other, and may die."""

import json
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Answer:
    """How a command ended."""

    code: int
    """0: done."""
    seconds: float


class WorkerProcess:
    """Starts its process when it is first needed, and again after it has died."""

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        self._command, self._folder = list(command), folder
        self._process: subprocess.Popen[str] | None = None
        self._stopped = False

    def run(self, arguments: Sequence[str], log: Path) -> Answer | None:
        """Carry out one command line in the folder; None where the process died of it."""
        process = self._started()
        told = json.dumps({"arguments": list(arguments), "log": str(log.resolve())})
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(told + "\n")
            process.stdin.flush()
            answer = process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            self._end(process)
            return None
        values = json.loads(answer)
        return Answer(int(values["code"]), float(values["seconds"]))

    def stop(self) -> None:
        """End the process, whatever it is at; may be called from another thread."""
        self._stopped = True
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """Let the process end, once it has nothing more to do."""
        if self._process is not None:
            self._end(self._process)

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None:
            self._process = subprocess.Popen(
                self._command,
                cwd=self._folder,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                # Ctrl-C reaches the owner alone, which ends the workers.
                start_new_session=True,
            )
            if self._stopped:
                self._process.kill()
        return self._process

    def _end(self, process: subprocess.Popen[str]) -> None:
        self._process = None
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                try:
                    pipe.close()
                except BrokenPipeError:
                    continue  # it died with something unread
        process.wait()
