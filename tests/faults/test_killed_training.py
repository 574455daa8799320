"""After kill -9 while a checkpoint is saved, a whole checkpoint is there to resume from."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from contactgraph.model import PRESETS, ModelConfig
from contactgraph.train import RunFolder, TrainConfig, initial_state, load_checkpoint

SPAWNER = """
import os, signal, sys, time
import dataclasses
from pathlib import Path
import jax, numpy as np
from contactgraph.model import ModelConfig, PRESETS
from contactgraph.train import (
    FitProgress, HeldOutBaselines, TrainConfig, RunFolder, initial_state
)

folder = RunFolder(Path(sys.argv[1]))
model = PRESETS["ours-recurrent"](ModelConfig(2, 2, 0.05), key=jax.random.key(0))
state = initial_state(model, TrainConfig(), 0)
folder.create({}, state)
# A forked child must not touch JAX, only its numbers.
state = jax.tree.map(lambda leaf: np.asarray(leaf) if hasattr(leaf, "shape") else leaf, state)

def save_for_ever():
    start = int(folder.checkpoints()[-1].stem.split("-")[1])
    for step in range(start + 1, 1_000_000):
        now = dataclasses.replace(
            state, step=np.asarray(step, np.int32), key=np.full((2,), step, np.uint32)
        )
        baselines = HeldOutBaselines(1.0, 1.0, True)
        folder.save(FitProgress(step, 1_000_000, {}, float(step), 0.0, now, baselines))

for pause in sys.stdin:
    child = os.fork()
    if child == 0:
        save_for_ever()
    time.sleep(float(pause))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    print("killed", flush=True)
"""


@pytest.mark.slow
def test_killed_at_any_moment_a_run_has_a_whole_checkpoint(tmp_path: Path) -> None:
    run = tmp_path / "run"
    like = initial_state(
        PRESETS["ours-recurrent"](ModelConfig(2, 2, 0.05), key=jax.random.key(0)), TrainConfig(), 0
    )
    reached, litter = 0, 0
    with subprocess.Popen(
        [sys.executable, "-c", SPAWNER, str(run)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as spawner:
        assert spawner.stdin is not None and spawner.stdout is not None
        for pause in np.random.default_rng(0).uniform(0.0, 0.05, size=40):
            print(pause, file=spawner.stdin, flush=True)
            assert spawner.stdout.readline() == "killed\n"
            folder = RunFolder(run)
            for path in folder.checkpoints():
                step = int(load_checkpoint(path, like).step)
                assert path.name == f"checkpoint-{step:010d}.safetensors"
            state = folder.latest(like)
            step = int(state.step)
            assert step >= reached, "nothing that was saved is lost"
            assert step == 0 or np.all(np.asarray(state.key) == step)
            steps = [row["step"] for row in folder.metrics()]
            # A kill after the row and before its checkpoint leaves one row ahead, never behind.
            assert steps in ([*range(1, step + 1)], [*range(1, step + 2)])
            assert json.loads((run / "config.json").read_text()) == {}
            litter += len(list(run.glob(".*.tmp")))
            reached = step
    assert reached > 0
    assert litter > 0, "no kill hit the middle of a write: the test shows nothing"
