"""Ctrl-C, and a loss that breaks, in the real command."""

import dataclasses
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
import safetensors.numpy

from contactgraph.cli import main as cli
from contactgraph.model import gim_temp
from contactgraph.train import RunFolder, TrainConfig, initial_state, save_checkpoint

MAIN = """
import signal, sys
from contactgraph.cli.main import main
signal.signal(signal.SIGINT, signal.default_int_handler)
main(sys.argv[1:])
"""
"""It hears Ctrl-C even where a shell lets what it starts in the background ignore it."""


def test_ctrl_c_leaves_a_run_that_resumes(recorded: Path, trained: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = ["train", str(recorded), "--out", str(run), "--steps", "300"]
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


def test_a_loss_that_is_not_finite_is_said_and_breaks_nothing(
    recorded: Path, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    for path in RunFolder(run).checkpoints():
        path.unlink()
    state = initial_state(
        gim_temp(2, 2, 0.05, 0.1, key=jax.random.key(0)), TrainConfig(steps=300), 0
    )
    broken = jax.tree.map(
        lambda leaf: leaf * jnp.nan if eqx.is_inexact_array(leaf) else leaf, state.model
    )
    save_checkpoint(
        run / "checkpoint-0000000000.safetensors", dataclasses.replace(state, model=broken)
    )
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    assert cli.run(["train", str(recorded), "--out", str(run), "--resume"]) == 2
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1].startswith(
        f"contactgraph: {run}: the loss became infinite"
    )
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before
