"""Where commands and MPC compute: on the CPU, unless the caller wants it otherwise."""

import subprocess
import sys

import pytest

from contactgraph.cli import main as cli

PLAN = """
import jax, sys
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
if sys.argv[1:]:
    jax.config.update("jax_default_device", found()[0])
mpc = MPC(model, ILQR(horizon=3))
state = mpc.reset(observation, scene_nodes(task.scene), cost)
for _ in range(2):
    plan, state = mpc.step(observation, observation["contact"], state)
    assert np.all(np.isfinite(plan.controls))
leaves = jax.tree.leaves((plan.states, state.carry))
print({device.id for leaf in leaves for device in leaf.devices()})
"""


@pytest.mark.parametrize(("settings", "device"), [((), 1), (("chosen",), 0)])
def test_a_control_step_stays_on_the_cpu_unless_the_caller_has_chosen(
    settings: tuple[str, ...], device: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    run = [sys.executable, "-c", PLAN, *settings]
    answer = subprocess.run(run, capture_output=True, text=True, check=False)
    assert answer.stdout == f"{{{device}}}\n", answer.stderr


def _device_of(arguments: list[str], before: str = "") -> str:
    """The device that a command leaves JAX with, and what it has said."""
    script = f"""
import jax, sys
{before}
from contactgraph.cli import main
code = main.run({arguments!r})
print(code, jax.config.jax_platforms)
"""
    run = [sys.executable, "-c", script]
    answer = subprocess.run(run, capture_output=True, text=True, check=True)
    return f"{answer.stdout.splitlines()[-1]} {answer.stderr.splitlines()[0]}"


def test_commands_compute_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    missing = "contactgraph: no.h5: does not exist"
    assert _device_of(["evaluate", "pickup", "no.h5"]).startswith(f"2 cpu {missing}")
    plugin = "import importlib.metadata as m, contactgraph.cli.options as o\n"
    plugin += "o.entry_points = lambda group: ['a GPU'] if group == 'jax_plugins' else ()"
    assert _device_of(["evaluate", "pickup", "no.h5"], plugin).startswith("2 cpu device: cpu:0")
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert "device" not in _device_of(["evaluate", "pickup", "no.h5"], plugin)


def test_a_gpu_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["evaluate", "pickup", "no.h5", "--device", "gpu"]) == 2
    assert "--device gpu: JAX finds no accelerator" in capsys.readouterr().err
    assert cli.run(["train", "no.h5", "--out", "run", "--device", "tpu"]) == 2
    assert "--device must be one of auto, cpu, gpu; found 'tpu'" in capsys.readouterr().err
