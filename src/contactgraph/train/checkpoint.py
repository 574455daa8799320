"""Checkpoints: all that training carries, in one file that is there whole or not at all."""

import json
from pathlib import Path

import safetensors
import safetensors.numpy

from contactgraph.data.atomic_file import replacing
from contactgraph.data.errors import InvalidInputError
from contactgraph.model.arrays import module_arrays, with_arrays
from contactgraph.train.fit import FitState

FORMAT = "contactgraph-checkpoint"
VERSION = 1


def save_checkpoint(path: Path, state: FitState) -> None:
    """Write the state atomically: whoever looks sees the old file or the whole new one."""
    header = {"format": FORMAT, "format_version": str(VERSION)}
    content = safetensors.numpy.save(
        module_arrays(state), metadata={"contactgraph": json.dumps(header)}
    )
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def load_checkpoint(path: Path, like: FitState) -> FitState:
    """The saved state; `like` is a state of the same model and recipe.

    Raises `InvalidInputError` where the file is damaged, or of another model.
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
