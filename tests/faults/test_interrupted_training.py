"""Ctrl-C, and a loss that is not finite, in the command."""

import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import safetensors.numpy

from contactgraph.cli import main as cli
from contactgraph.train import FitResult, FitStatus, HeldOutBaselines, RunFolder

SHORT = (
    *("--model", "ours-recurrent", "--steps", "12", "--batch-size", "4"),
    *("--window-length", "3", "--rollout-from", "0.6"),
)
"""The options of the fixture `trained`."""

MAIN = """
import signal, sys
from functools import partial
import contactgraph.train as train
from contactgraph.cli.main import main
train.TrainConfig = partial(train.TrainConfig, check_every=4)
signal.signal(signal.SIGINT, signal.default_int_handler)
main(sys.argv[1:])
"""
"""It reacts to Ctrl-C even where a shell lets background processes ignore it."""


@pytest.mark.slow
def test_ctrl_c_leaves_a_run_that_resumes(
    recorded: Path, trained: Path, tmp_path: Path, frequent_checks: None
) -> None:
    run = tmp_path / "run"
    command = ["train", str(recorded), "--out", str(run), *SHORT]
    with subprocess.Popen(
        [sys.executable, "-c", MAIN, *command],
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        deadline = time.monotonic() + 60
        while not list(run.glob("checkpoint-*")) and time.monotonic() < deadline:
            time.sleep(0.005)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=120)
    assert process.returncode == 130
    assert said.splitlines()[-1] == "contactgraph: interrupted"
    assert "Traceback" not in said
    assert not list(run.glob(".*.tmp"))
    assert cli.run(["train", str(recorded), "--out", str(run), "--resume"]) == 0
    for path in [*RunFolder(trained).checkpoints(), trained / "model.safetensors"]:
        ours = safetensors.numpy.load_file(run / path.name)
        for name, array in safetensors.numpy.load_file(path).items():
            assert array.tobytes() == ours[name].tobytes(), (path.name, name)


def test_a_loss_that_is_not_finite_is_reported_and_no_model_is_written(
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fit(state, train, held_out, config, on_check, devices, near_pairs):
        baselines = HeldOutBaselines(1.0, 1.0, True)
        return FitResult(state.best_model, math.inf, FitStatus.not_finite, state, 1.0, baselines)

    monkeypatch.setattr("contactgraph.train.fit", fit)
    run = tmp_path / "run"
    assert cli.run(["train", str(recorded), "--out", str(run), *SHORT]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(f"contactgraph: {run}: the loss became infinite")
    assert RunFolder(run).checkpoints() and not (run / "model.safetensors").exists()
