"""Where commands and MPC compute: on the CPU, unless the caller wants it otherwise."""

import subprocess
import sys

import pytest

from contactgraph.cli import main as cli

PLAN = """
import jax
import numpy as np
import contactgraph
from contactgraph.control import ILQR, MPC, chain_cost, host
from contactgraph.model import scene_nodes

model, task = contactgraph.load("pickup"), contactgraph.make("pickup")
observation, _ = task.reset(seed=0)
cost = chain_cost([0, 1], [3, 3, 0, 0], [50, 50, 1, 1], 0.01, task.scene.goal, node_count=2)
# A second CPU device stands for the CPU beside a GPU, which JAX would take.
jax.default_backend = lambda: "gpu"
found = jax.devices
jax.devices = lambda name=None: found()[1:] if name == "cpu" else found()
for chosen in (None, found()[0]):
    jax.config.update("jax_default_device", chosen)
    mpc = MPC(model, ILQR(horizon=3))
    state = mpc.reset(observation, scene_nodes(task.scene), cost)
    for _ in range(2):
        plan, state = mpc.step(observation, observation["contact"], state)
        assert np.all(np.isfinite(plan.controls))
    leaves = jax.tree.leaves((plan.states, state.carry))
    print({device.id for leaf in leaves for device in leaf.devices()})
"""


def test_a_control_step_stays_on_the_cpu_unless_the_caller_has_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    run = [sys.executable, "-c", PLAN]
    answer = subprocess.run(run, capture_output=True, text=True, check=False)
    assert answer.stdout == "{1}\n{0}\n", answer.stderr


def test_commands_compute_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """They say so where a plugin of JAX gives a choice that no variable has made."""
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    script = """
import jax, os
from contactgraph.cli import main, options

command = ["evaluate", "pickup", "no.h5"]
codes = [main.run(command)]
options.entry_points = lambda group: ["a GPU"] if group == "jax_plugins" else ()
codes.append(main.run(command))
os.environ["JAX_PLATFORMS"] = "cpu"
codes.append(main.run(command))
print(codes, jax.config.jax_platforms)
"""
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert answer.stdout == "[2, 2, 2] cpu\n"
    missing, device, *others = answer.stderr.splitlines()
    assert missing == "contactgraph: no.h5: does not exist" and others == [missing] * 2
    assert device == "device: cpu:0"


def test_a_gpu_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["evaluate", "pickup", "no.h5", "--device", "gpu"]) == 2
    assert "--device gpu: JAX finds no accelerator" in capsys.readouterr().err
    assert cli.run(["train", "no.h5", "--out", "run", "--device", "tpu"]) == 2
    assert "--device must be one of auto, cpu, gpu; found 'tpu'" in capsys.readouterr().err
