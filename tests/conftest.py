"""Shared by all tests: the folder of compiled programs, and one small trained run."""

import os
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

# Set before anything imports JAX. Compilation takes most of a test's time, so compiled programs are
# kept in a folder of the repository, which workers and subprocesses share.
_CACHE = Path(__file__).resolve().parents[1] / ".cache" / "jax"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

import jax  # noqa: E402  after what it goes by

_MOST_MAPS = 20_000

SHORT = ("--steps", "12", "--batch-size", "4", "--window-length", "3", "--rollout-from", "0.6")
"""Options of the shared training: three checks, the rollout term from the last one on."""


def pytest_configure(config: pytest.Config) -> None:
    # A worker that dies while it stores a program leaves half of it. JAX warns and compiles again.
    config.addinivalue_line(
        "filterwarnings", "ignore:Error (reading|writing) persistent:UserWarning"
    )


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    # Every compiled program maps some memory, of which Linux lets a process have 65,530 pieces; one
    # that has used them up dies at the next.
    if nextitem is None or nextitem.path != item.path:
        maps = Path("/proc/self/maps")
        if maps.exists() and maps.read_bytes().count(b"\n") > _MOST_MAPS:
            jax.clear_caches()


def _done(arguments: list[str]) -> None:
    from contactgraph.cli.main import run

    assert run(arguments) == 0


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20 recorded pickups, to train on."""
    path = tmp_path_factory.mktemp("recorded") / "data.h5"
    _done(["collect", "pickup", "--episodes", "20", "--out", str(path)])
    return path


@pytest.fixture(scope="session")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """6 pickups of another seed, to test on."""
    path = tmp_path_factory.mktemp("fresh") / "data.h5"
    _done(["collect", "pickup", "--episodes", "6", "--seed", "1", "--out", str(path)])
    return path


@pytest.fixture(scope="session")
def trained(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a training of 12 steps with a check every 4. Read only."""
    path = tmp_path_factory.mktemp("trained") / "run"
    with pytest.MonkeyPatch.context() as patch:
        _check_every_4(patch)
        _done(["train", str(recorded), "--out", str(path), *SHORT])
    return path


@pytest.fixture
def frequent_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trainings by the command check every 4 steps, as the one of `trained` did."""
    _check_every_4(monkeypatch)


def _check_every_4(patch: pytest.MonkeyPatch) -> None:
    from contactgraph.train import TrainConfig

    patch.setattr("contactgraph.train.TrainConfig", partial(TrainConfig, check_every=4))


@pytest.fixture(scope="module")
def server_turn() -> Iterator[None]:
    """For tests with a simulated arm's server: a module at a time, in whatever process they run."""
    import fcntl

    with (Path(tempfile.gettempdir()) / "contactgraph-server-turn.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
