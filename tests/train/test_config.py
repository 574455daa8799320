"""Invalid configurations and run folders."""

import math
from pathlib import Path

import pytest
from training import first_state

from contactgraph.data import InvalidInputError
from contactgraph.train import RunFolder, TrainConfig


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps", 0),
        ("steps", 10**12),
        ("batch_size", 0),
        ("batch_size", 10**9),
        ("window_length", -1),
        ("event_fraction", 1.5),
        ("event_fraction", math.nan),
        ("rollout_from", -0.1),
        ("bystanders", -1),
        ("bystanders", 10**6),
        ("patience", 0),
        ("check_every", 0),
        ("learning_rate", 0.0),
        ("learning_rate", math.inf),
        ("learning_rate", math.nan),
    ],
)
def test_a_number_out_of_range_is_named(name: str, value: float) -> None:
    with pytest.raises(InvalidInputError, match=f"^{name} must be .*, found {value}$"):
        TrainConfig(**{name: value})


def test_a_run_begins_in_a_new_or_empty_folder(tmp_path: Path) -> None:
    RunFolder(tmp_path / "a" / "run").create({"seed": 1}, first_state())
    begun = RunFolder(tmp_path / "a" / "run")
    assert begun.config() == {"seed": 1}
    assert begun.metrics() == []
    assert [path.name for path in begun.checkpoints()] == ["checkpoint-0000000000.safetensors"]
    with pytest.raises(InvalidInputError, match="holds a run already; use --resume"):
        begun.create({}, first_state())
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter").touch()
    with pytest.raises(InvalidInputError, match="must be a new or empty folder"):
        RunFolder(tmp_path / "full").create({}, first_state())
    with pytest.raises(InvalidInputError, match="must be a new or empty folder"):
        RunFolder(tmp_path / "full" / "letter").create({}, first_state())
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["letter"]
