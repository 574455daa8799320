"""The record beside a cell's output: which command made it, and whether it was finished."""

import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from contactgraph.data import atomic_write
from contactgraph_studies.cell import Cell


@dataclass(frozen=True)
class Records:
    """The records of a study's folder. A cell without one, or with another's, is to be made."""

    folder: Path
    version: str
    """Of the package; what another version made is made anew."""

    def seconds(self, cell: Cell) -> float | None:
        """How long the cell took; None where it is not done."""
        record = self._read(cell)
        if not (self._fits(cell, record) and record.get("finished") is True):
            return None
        return float(record["seconds"]) if (self.folder / cell.output).exists() else None

    def begin(self, cell: Cell) -> tuple[str, ...]:
        """Clear the way for the cell; the arguments to make it with.

        What another command left is removed. A training that was begun by this very command goes
        on from its checkpoint.
        """
        output = self.folder / cell.output
        resumable = cell.checkpoints and any(output.glob(cell.checkpoints))
        if resumable and self._fits(cell, self._read(cell)):
            self._write(cell, finished=False, seconds=0.0)
            return (*cell.arguments, "--resume")
        if output.is_dir():
            shutil.rmtree(output)
        output.unlink(missing_ok=True)
        output.parent.mkdir(parents=True, exist_ok=True)
        self._write(cell, finished=False, seconds=0.0)
        return cell.arguments

    def finish(self, cell: Cell, seconds: float) -> None:
        """The cell is made."""
        self._write(cell, finished=True, seconds=seconds)

    def log_path(self, cell: Cell) -> Path:
        """What the command says while it runs."""
        return self.folder / f"{cell.output}.log"

    def _path(self, cell: Cell) -> Path:
        return self.folder / f"{cell.output}.made.json"

    def _fits(self, cell: Cell, record: dict) -> bool:
        return (record.get("fingerprint"), record.get("version")) == (
            cell.fingerprint,
            self.version,
        )

    def _read(self, cell: Cell) -> dict:
        try:
            record = json.loads(self._path(cell).read_text())
        except (OSError, ValueError):
            return {}
        return record if isinstance(record, dict) else {}

    def _write(self, cell: Cell, finished: bool, seconds: float) -> None:
        record = {
            "command": cell.command,
            "fingerprint": cell.fingerprint,
            "version": self.version,
            "finished": finished,
            "seconds": round(seconds, 3),
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        }
        with atomic_write(self._path(cell)) as temporary:
            temporary.write_text(json.dumps(record, indent=2) + "\n")
