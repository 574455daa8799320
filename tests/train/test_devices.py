"""A batch split over several devices trains the model that one device trains."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.train.batch import batch_split

PROGRAM = Path(__file__).with_name("on_devices.py")


@pytest.mark.slow
def test_four_devices_train_what_one_trains(recorded: Path) -> None:
    """Double precision: in single precision, Adam makes whole steps of mere rounding errors."""
    finished = subprocess.run(
        [sys.executable, "-W", "error", str(PROGRAM), str(recorded)],
        env={
            **os.environ,
            "JAX_ENABLE_X64": "1",
            "JAX_PLATFORMS": "cpu",
            "XLA_FLAGS": "--xla_force_host_platform_device_count=4",
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    devices, moved, apart, error_apart = map(float, finished.stdout.split())
    assert devices == 4
    assert moved > 1e-3
    assert apart < 1e-8 and error_apart < 1e-8


def test_one_device_splits_nothing() -> None:
    assert batch_split((), 7) is None
    assert batch_split(jax.local_devices()[:1], 7) is None


def test_a_batch_that_does_not_come_out_even() -> None:
    with pytest.raises(InvalidInputError, match="a batch of 32 windows cannot be split evenly ove"):
        batch_split(jax.local_devices()[:1] * 3, 32)
