"""An interrupted and resumed training equals an uninterrupted one to the last bit."""

import itertools
import json
import shutil
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
import safetensors.numpy
from training import assert_bit_equal, first_state, split, states_until, trained_on

from contactgraph.cli import main as cli
from contactgraph.data import InvalidInputError
from contactgraph.train import FitProgress, RunFolder, load_checkpoint, save_checkpoint

pytestmark = pytest.mark.usefixtures("trained")  # it fills the compilation cache


def test_from_any_checkpoint_on(recorded: Path, tmp_path: Path) -> None:
    """One check before the rollout joins the loss, and one where it does."""
    parts, path = split(recorded), tmp_path / "checkpoint.safetensors"
    straight = trained_on(parts, first_state())
    for steps in (4, 8):
        interrupted = states_until(steps, first_state(), parts)
        save_checkpoint(path, interrupted)
        restored = load_checkpoint(path, first_state(1))
        assert_bit_equal(restored, interrupted)
        resumed = trained_on(parts, restored)
        assert_bit_equal(resumed.state, straight.state)
        assert resumed.held_out_rmse_m == straight.held_out_rmse_m
        assert resumed.status is straight.status


def test_the_latest_checkpoint_of_a_folder_holds_the_whole_state(tmp_path: Path) -> None:
    """Every array differs from that of a fresh state, so that none can be left out unnoticed."""
    folder = RunFolder(tmp_path / "run")
    folder.create({}, first_state())
    counter = itertools.count(1)

    def shifted(leaf: object) -> object:
        return leaf + np.asarray(next(counter), leaf.dtype) if eqx.is_array(leaf) else leaf

    states = [jax.tree.map(shifted, first_state()) for _ in range(2)]
    for step, state in enumerate(states, start=1):
        folder.save(FitProgress(step, 2, {}, 1.0, 0.0, state))
    restored = folder.latest(first_state(1))
    assert_bit_equal(restored.optimiser, states[-1].optimiser)
    assert_bit_equal(restored, states[-1])
    assert_bit_equal(load_checkpoint(folder.checkpoints()[0], first_state(1)), states[0])


def rewound(run: Path, to: Path, step: int) -> Path:
    """A copy of a run as it was at a checkpoint, its best model still an older one's."""
    shutil.copytree(run, to)
    folder = RunFolder(to)
    for path in folder.checkpoints():
        if path.name > f"checkpoint-{step:010d}.safetensors":
            path.unlink()
    assert folder.checkpoints()
    (to / "model.safetensors").unlink()
    return to


def rows(run: Path) -> list[dict]:
    return [{**row, "seconds": 0} for row in RunFolder(run).metrics()]


def weights(path: Path) -> dict:
    return {name: a.tobytes() for name, a in safetensors.numpy.load_file(path).items()}


@pytest.mark.parametrize("step", [8, 12])
def test_the_command_leaves_the_same_folder(
    recorded: Path, trained: Path, tmp_path: Path, frequent_checks: None, step: int
) -> None:
    """12 is a training killed between its last checkpoint and its model."""
    run = rewound(trained, tmp_path / "run", step)
    assert cli.run(["train", str(recorded), "--out", str(run), "--resume"]) == 0
    assert rows(run) == rows(trained)
    assert [path.name for path in RunFolder(run).checkpoints()] == [
        path.name for path in RunFolder(trained).checkpoints()
    ]
    for path in [*RunFolder(trained).checkpoints(), trained / "model.safetensors"]:
        assert weights(run / path.name) == weights(path), path.name


def test_a_row_without_its_checkpoint_is_measured_again(trained: Path, tmp_path: Path) -> None:
    """A kill between measurements and checkpoint leaves one row too many, never one too few."""
    run = rewound(trained, tmp_path / "run", 8)
    assert [row["step"] for row in RunFolder(run).metrics()] == [4, 8, 12]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a whole checkpoint"),
        (b"\x08\0\0\0\0\0\0\0{}      ", "not a checkpoint of contactgraph training"),
        (b"nonsense, and a lot of it", "not a whole checkpoint"),
    ],
)
def test_a_damaged_checkpoint(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(content)
    with pytest.raises(InvalidInputError, match=message):
        load_checkpoint(path, first_state())


def test_a_truncated_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, first_state())
    whole = path.read_bytes()
    for share in (0.01, 0.5, 0.999):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InvalidInputError, match="not a whole checkpoint"):
            load_checkpoint(path, first_state())


def test_a_run_that_cannot_be_resumed(recorded: Path, trained: Path, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    with pytest.raises(InvalidInputError, match="has no checkpoint to resume from"):
        folder.latest(first_state())
    with pytest.raises(InvalidInputError, match="not a run folder"):
        folder.config()
    (tmp_path / "metrics.jsonl").write_text(json.dumps({"step": 1}) + "\n")
    with pytest.raises(InvalidInputError, match="line 1 must have a number 'held_out_rmse_m'"):
        folder.metrics()
