"""The hooks that the documents show write what a training tells them."""

import re
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from tensorboardX import SummaryWriter
from tensorboardX.proto.event_pb2 import Event

from contactgraph.train import FitProgress, FitState, HeldOutBaselines

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
CHECK = FitProgress(
    step=100,
    steps=200,
    terms={"prediction": 0.25},
    held_out_rmse_m=0.01,
    seconds=12.0,
    state=cast(FitState, None),
    baselines=HeldOutBaselines(0.05, 0.1, True),
)
NUMBERS = {
    "prediction": 0.25,
    "held_out_rmse_m": 0.01,
    "constant_velocity_rmse_m": 0.05,
    "seconds": 12.0,
}


@pytest.fixture(scope="module")
def hooks() -> dict[str, Any]:
    """The functions of the page."""
    block = re.search(r"```python\n(def numbers.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert block is not None
    names: dict[str, Any] = {}
    exec(block[1], names)
    return names


def events(folder: Path) -> list[Event]:
    """The records of the one file in a folder: length, its checksum, data, their checksum."""
    (file,) = folder.iterdir()
    data, found, start = file.read_bytes(), [], 0
    while start < len(data):
        (length,) = struct.unpack_from("<Q", data, start)
        found.append(Event.FromString(data[start + 12 : start + 12 + length]))
        start += length + 16
    return found


def test_tensorboard_gets_every_number(hooks: dict[str, Any], tmp_path: Path) -> None:
    with SummaryWriter(str(tmp_path)) as writer:
        hooks["to_tensorboard"](writer)(CHECK)
    written = [(e.step, v.tag, v.simple_value) for e in events(tmp_path) for v in e.summary.value]
    assert written == [(100, name, pytest.approx(value)) for name, value in NUMBERS.items()]


def test_weights_and_biases_gets_every_number(hooks: dict[str, Any]) -> None:
    logged: list[tuple[dict[str, float], int]] = []
    run = SimpleNamespace(log=lambda numbers, step: logged.append((numbers, step)))
    hooks["to_wandb"](run)(CHECK)
    assert logged == [(NUMBERS, 100)]
