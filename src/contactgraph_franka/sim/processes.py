"""Processes that end with the one that started them, and say why when they end before."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from contactgraph.data import InvalidInputError

_START = 30.0
"""s: for so long a process may take to be ready."""
_END = 2.0
"""s: for so long it may take to end when asked to."""
_MISTAKE = "contactgraph.data.errors.InvalidInputError: "


class Child:
    """``python -m MODULE FOLDER``, whose last words are kept in the folder."""

    def __init__(self, module: str, folder: Path, environment: Mapping[str, str] | None = None):
        self._module = module
        self._log = folder / f"{module.rpartition('.')[2]}.log"
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, str(folder)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **(environment or {})},
                # Ctrl-C is for the owner to answer.
                start_new_session=True,
            )

    def wait_until(self, ready: Callable[[], bool]) -> None:
        """Waits until ``ready()``; raises as `check` does, and `RuntimeError` after 30 s."""
        until = time.monotonic() + _START
        while not ready():
            self.check()
            if time.monotonic() > until:
                raise RuntimeError(f"{self._module} was not ready within {_START:.0f} s")
            time.sleep(0.01)

    def check(self) -> None:
        """Raises what the process died of: `InvalidInputError`, or else `RuntimeError`."""
        code = self._process.poll()
        if code is None:
            return
        words = self._log.read_text().strip().splitlines() if self._log.exists() else []
        last = words[-1] if words else "without a word"
        if last.startswith(_MISTAKE):
            raise InvalidInputError(last.removeprefix(_MISTAKE))
        raise RuntimeError(f"{self._module} ended with code {code}: {last}")

    def close(self) -> None:
        """Ends it."""
        self._process.terminate()
        try:
            self._process.wait(_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
