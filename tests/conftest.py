"""Shared by all tests: the folder of compiled programs, and one small trained run."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest

_FAST_COMPILATION = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
    " --xla_cpu_parallel_codegen_split_count=1"
)
"""These flags halve the time that XLA takes to compile. The programs run more slowly."""


def _accepted(flags: str) -> bool:
    """True unless the installed XLA lacks one of the flags: it then aborts the process."""
    return (
        subprocess.run(
            [sys.executable, "-c", "import jax; jax.devices()"],
            env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        ).returncode
        == 0
    )


# The variables are set before JAX is imported, and workers and subprocesses inherit them.
# Compilation takes most of a test's time. Hence compiled programs are kept in a folder of the
# repository, and the fast tests compile without optimisation. The Makefile sets XLA_FLAGS to
# nothing for the other tests, so that they run the programs that users run.
_CACHE = Path(__file__).resolve().parents[1] / ".cache" / "jax"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Source locations within programs cost 5 % of the time of compilation.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = _FAST_COMPILATION if _accepted(_FAST_COMPILATION) else ""

import jax  # noqa: E402  after the variables that it reads

from contactgraph_studies.execution import release_programs, resident_bytes  # noqa: E402

MUCH_MEMORY = 1.5e9
"""Of a worker, bytes, above which it forgets compiled programs."""
SHORT = (
    *("--model", "ours-recurrent", "--steps", "12", "--batch-size", "4"),
    *("--window-length", "3", "--rollout-from", "0.6"),
)
"""Options of the shared training: three checks, the rollout term from the last one on; a model that
compiles in half the time of the default."""


def pytest_configure(config: pytest.Config) -> None:
    # A worker that dies while it stores a program leaves half of it. JAX warns and compiles again.
    config.addinivalue_line(
        "filterwarnings", "ignore:Error (reading|writing) persistent:UserWarning"
    )


def pytest_runtest_teardown() -> None:
    # Compiled programs take most of a worker's memory. Those that are forgotten are traced again
    # and read from the folder, which takes a quarter of the time of all tests if each file does it.
    if resident_bytes() > MUCH_MEMORY:
        release_programs()


def _done(arguments: list[str]) -> None:
    from contactgraph.cli.main import run

    assert run(arguments) == 0


def _shared(factory: pytest.TempPathFactory, name: str, create: Callable[[Path], None]) -> Path:
    """The path that `create` writes, in the first worker that needs it, for all workers."""
    import fcntl

    folder = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    finished = path.with_suffix(".finished")
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not finished.exists():
            create(path)
            finished.touch()
    return path


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20 recorded pickups, to train on. Read only."""
    collect = ["collect", "pickup", "--episodes", "20", "--out"]
    return _shared(tmp_path_factory, "recorded/data.h5", lambda path: _done([*collect, str(path)]))


@pytest.fixture(scope="session")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """6 pickups of another seed, to test on. Read only."""
    collect = ["collect", "pickup", "--episodes", "6", "--seed", "1", "--out"]
    return _shared(tmp_path_factory, "fresh/data.h5", lambda path: _done([*collect, str(path)]))


@pytest.fixture(scope="session")
def trained(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a training of 12 steps with a check every 4. Read only."""

    def train(path: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            _check_every_4(patch)
            _done(["train", str(recorded), "--out", str(path), *SHORT])

    return _shared(tmp_path_factory, "trained/run", train)


@pytest.fixture
def double_precision() -> Iterator[None]:
    """float64 within one test: where differences are small, or contacts enlarge rounding."""
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


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


@pytest.fixture(scope="module", params=["box2d", "pymunk"])
def engine(request: pytest.FixtureRequest) -> Iterator[str]:
    """The engine that planar worlds take by default, one after the other."""
    from contactgraph.envs.planar import world

    if find_spec(world.ENGINES[request.param]) is None:
        pytest.skip(f"{request.param} is not installed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(world, "ENGINES", {request.param: world.ENGINES[request.param]})
        yield request.param
