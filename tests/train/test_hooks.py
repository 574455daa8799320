"""The hooks that the documents show write what a training tells them."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import call, create_autospec

import pytest
from tensorboardX import SummaryWriter

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


def test_tensorboard_gets_every_number(hooks: dict[str, Any]) -> None:
    writer = create_autospec(SummaryWriter, instance=True)
    hooks["to_tensorboard"](writer)(CHECK)
    assert writer.add_scalar.mock_calls == [call(*each, 100) for each in NUMBERS.items()]


def test_weights_and_biases_gets_every_number(hooks: dict[str, Any]) -> None:
    logged: list[tuple[dict[str, float], int]] = []
    run = SimpleNamespace(log=lambda numbers, step: logged.append((numbers, step)))
    hooks["to_wandb"](run)(CHECK)
    assert logged == [(NUMBERS, 100)]
