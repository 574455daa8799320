"""Runs of a recording that was interrupted, kept beside the file that it was to become."""

import hashlib
import json
import shutil
import sys
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from contactgraph.data import InvalidInputError, Trajectory, read_trajectories, write_trajectories

_EVERY_S = 10.0
"""A process that is killed loses the runs of no longer than this."""


class UnfinishedRuns:
    """A folder beside ``path``, named by what shapes the runs, so that only the same go on.

    It holds files of some runs each, named by their first one's number, and is there only where
    there was something to keep. As a context, it keeps all runs where the block is left by an
    exception, Ctrl-C among them, and says so.
    """

    def __init__(self, path: Path, inputs: Mapping[str, Any]) -> None:
        """``inputs``: by name, in values that JSON knows, all on which the runs depend."""
        told = json.dumps({**inputs, "version": version("contactgraph")}, sort_keys=True)
        fingerprint = hashlib.sha256(told.encode()).hexdigest()[:12]
        self.folder = path.with_name(f"{path.name}.unfinished-{fingerprint}")
        self.found = self._read()
        """The first runs, as recorded before."""
        self._kept, self._new = len(self.found), list[Trajectory]()
        self._kept_s = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            return
        self._keep()
        if self._kept:
            print(
                f"{self.folder}: {self._kept} runs are kept; the same command goes on from there",
                file=sys.stderr,
            )

    def add(self, run: Trajectory) -> int:
        """The next run, kept with those before it some seconds later; how many there are now."""
        self._new.append(run)
        if time.monotonic() - self._kept_s >= _EVERY_S:
            self._keep()
        return self._kept + len(self._new)

    def remove(self) -> None:
        """They are in the file now."""
        if self.folder.is_dir():
            shutil.rmtree(self.folder)

    def _read(self) -> list[Trajectory]:
        """What is there without a gap; what cannot be read is recorded anew."""
        runs: list[Trajectory] = []
        for path in sorted(self.folder.glob("*.h5")):
            if path.stem != f"{len(runs):06d}":
                break
            try:
                runs.extend(read_trajectories(path))
            except InvalidInputError:
                break
        return runs

    def _keep(self) -> None:
        if self._new:
            self.folder.mkdir(exist_ok=True)
            write_trajectories(self.folder / f"{self._kept:06d}.h5", self._new)
            self._kept, self._new = self._kept + len(self._new), []
        self._kept_s = time.monotonic()
