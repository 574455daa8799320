"""The folder of a training run: its settings, checkpoints, measurements and best model."""

import json
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.files import atomic_write
from contactgraph.model.io import module_arrays, with_arrays
from contactgraph.train.fit import FitProgress
from contactgraph.train.objective import FitState

FORMAT = "contactgraph-checkpoint"
VERSION = 1


def save_checkpoint(path: Path, state: FitState) -> None:
    """Write the state to one file, atomically."""
    header = {"format": FORMAT, "format_version": str(VERSION)}
    content = safetensors.numpy.save(
        module_arrays(state), metadata={"contactgraph": json.dumps(header)}
    )
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def load_checkpoint(path: Path, like: FitState) -> FitState:
    """The saved state; `like` is a state of the same model and settings.

    Raises `InvalidInputError` where the file is damaged, or belongs to another model.
    """
    if not path.is_file():
        raise InvalidInputError(f"{path}: no such checkpoint")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            entry = (file.metadata() or {}).get("contactgraph", "{}")
            header = json.loads(entry)
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(f"{path}: not a whole checkpoint ({reason})") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InvalidInputError(f"{path}: not a checkpoint of contactgraph training")
    if header.get("format_version") != str(VERSION):
        raise InvalidInputError(
            f"{path}: format_version must be {VERSION}, found {header.get('format_version')!r}"
        )
    return with_arrays(like, arrays, str(path))


_CHECKPOINTS_KEPT = 2


class RunFolder:
    """``config.json``, ``metrics.jsonl``, ``checkpoint-*.safetensors`` and ``model.safetensors``.

    Every file is written atomically, so that a training killed at any moment can resume from its
    last checkpoint. Raises `InvalidInputError` where the folder cannot be used as requested.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def model_path(self) -> Path:
        """The best model so far; it exists from the first checkpoint on."""
        return self.path / "model.safetensors"

    def create(self, config: dict[str, Any], state: FitState) -> None:
        """Start a training run with its settings and its first state.

        Raises for a folder that holds a run already, or anything else.
        """
        if (self.path / "config.json").exists():
            raise InvalidInputError(
                f"{self.path}: holds a run already; use --resume, or another folder"
            )
        if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            raise InvalidInputError(f"{self.path}: must be a new or empty folder for the run")
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InvalidInputError(f"{self.path}: cannot be made ({error.strerror})") from error
        self._write("config.json", json.dumps(config, indent=2) + "\n")
        save_checkpoint(self._checkpoint(int(state.step)), state)

    def config(self) -> dict[str, Any]:
        """The settings of the run."""
        path = self.path / "config.json"
        if not path.is_file():
            raise InvalidInputError(f"{self.path}: not a run folder (it has no config.json)")
        try:
            config = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise InvalidInputError(f"{path}: not readable as JSON ({error})") from error
        if not isinstance(config, dict):
            raise InvalidInputError(f"{path}: must hold a JSON object")
        return config

    def save(self, progress: FitProgress) -> None:
        """Save a checkpoint and the measurements up to it; older checkpoints are deleted."""
        rows = [row for row in self.metrics() if row["step"] < progress.step]
        rows.append(
            {
                "step": progress.step,
                **progress.terms,
                "held_out_rmse_m": progress.held_out_rmse_m,
                "seconds": round(progress.seconds, 3),
            }
        )
        # Measurements first: a run killed in between measures this step once more. In the other
        # order it would continue after a step without measurements.
        self._write("metrics.jsonl", "".join(json.dumps(row) + "\n" for row in rows))
        save_checkpoint(self._checkpoint(progress.step), progress.state)
        for old in self.checkpoints()[:-_CHECKPOINTS_KEPT]:
            old.unlink(missing_ok=True)

    def metrics(self) -> list[dict[str, float]]:
        """One row a check: step, loss terms, held-out error [m], seconds."""
        path = self.path / "metrics.jsonl"
        if not path.is_file():
            return []
        try:
            rows = [json.loads(line) for line in path.read_text().splitlines()]
        except ValueError as error:
            raise InvalidInputError(f"{path}: not readable as JSON lines ({error})") from error
        for number, row in enumerate(rows, start=1):
            for name in ("step", "held_out_rmse_m", "seconds"):
                if not isinstance(row, dict) or not isinstance(row.get(name), int | float):
                    raise InvalidInputError(f"{path}: line {number} must have a number {name!r}")
        return rows

    def checkpoints(self) -> list[Path]:
        """All checkpoints, oldest first."""
        return sorted(self.path.glob("checkpoint-*.safetensors"))

    def latest(self, like: FitState) -> FitState:
        """The last checkpoint's state. Raises `InvalidInputError` where there is none."""
        found = self.checkpoints()
        if not found:
            raise InvalidInputError(f"{self.path}: has no checkpoint to resume from")
        return load_checkpoint(found[-1], like)

    def _checkpoint(self, step: int) -> Path:
        # Ten digits hold the largest number of steps, so that names sort as steps do.
        return self.path / f"checkpoint-{step:010d}.safetensors"

    def _write(self, name: str, text: str) -> None:
        with atomic_write(self.path / name) as temporary:
            temporary.write_text(text)
