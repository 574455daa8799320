"""Execution of one job in a worker process, on this machine or on another one."""

import ctypes
import gc
import os
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from contactgraph_studies.job import Job, JobRecords

_MOST_DRAWS = 5
"""Of the seed of a training whose network is dead."""
_MUCH_MEMORY = 3e9
"""Of a worker, bytes."""
_REDRAWN = 1000
"""Is added to a seed with every draw."""
FileBundle = tuple[tuple[str, bytes], ...]
"""Paths relative to a folder, and contents."""
RunCommand = Callable[[list[str], Path], int]
"""Runs a command line in the current folder with its output in a log file; the exit code."""


@dataclass(frozen=True)
class LocalJob:
    """A command line to run in the study's own folder."""

    arguments: tuple[str, ...]
    folder: Path
    log: Path


@dataclass(frozen=True)
class RemoteJob:
    """A command line to run in a new folder that holds the given files."""

    arguments: tuple[str, ...]
    files: FileBundle
    outputs: tuple[str, ...]
    """Files and folders to send back."""


@dataclass(frozen=True)
class JobResult:
    """The end of a command."""

    exit_code: int
    seconds: float
    files: FileBundle = ()
    """Outputs of a `RemoteJob`."""
    log: str = ""
    """Printed output of a `RemoteJob`."""
    draws: int = 1
    """Of a training, its seeds that were tried."""
    dead: bool = False
    """Whether it is a training whose networks are all dead."""


def prepare(job: Job, records: JobRecords, shares_files: bool) -> LocalJob | RemoteJob:
    """Clear the job's output and describe its execution, with or without a shared file system."""
    arguments = records.begin(job)
    if shares_files:
        return LocalJob(arguments, records.folder.absolute(), records.log_path(job).absolute())
    inputs = [path for need in job.needs for path in need.outputs]
    # The job's own outputs go along because a training resumes from its checkpoint.
    files = bundle_files(records.folder, [*inputs, *job.outputs])
    return RemoteJob(arguments, files, job.outputs)


def create_worker() -> Callable[[LocalJob | RemoteJob], JobResult]:
    """The function that a worker process calls for each job."""
    from contactgraph.cli.main import run  # not at the top: the command line imports the studies

    return partial(execute, run_command=partial(_run_logged, run))


def execute(job: LocalJob | RemoteJob, run_command: RunCommand) -> JobResult:
    """Run one job."""
    if isinstance(job, LocalJob):
        return _timed(job.arguments, job.folder, job.log, run_command)
    with tempfile.TemporaryDirectory(prefix="contactgraph-") as name:
        folder, log = Path(name) / "study", Path(name) / "log"
        folder.mkdir()
        write_bundle(job.files, folder)
        for output in job.outputs:
            (folder / output).parent.mkdir(parents=True, exist_ok=True)
        try:
            result = _timed(job.arguments, folder, log, run_command)
        finally:
            os.chdir(tempfile.gettempdir())  # some systems cannot remove the current folder
        files = bundle_files(folder, job.outputs) if result.exit_code == 0 else ()
        printed = log.read_text(errors="replace") if log.exists() else ""
        return replace(result, files=files, log=printed)


def bundle_files(folder: Path, paths: Iterable[str]) -> FileBundle:
    """The files at these paths, and all files in the folders at these paths, that exist."""
    contents: dict[str, bytes] = {}
    for path in paths:
        top = folder / path
        for file in sorted(top.rglob("*")) if top.is_dir() else [top]:
            if file.is_file():
                contents[file.relative_to(folder).as_posix()] = file.read_bytes()
    return tuple(contents.items())


def write_bundle(bundle: FileBundle, folder: Path) -> None:
    """Write the files into the folder."""
    for path, content in bundle:
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)


def _timed(
    arguments: tuple[str, ...], folder: Path, log: Path, run_command: RunCommand
) -> JobResult:
    os.chdir(folder)
    start, draws = time.perf_counter(), 1
    exit_code = run_command(list(arguments), log)
    while exit_code != 0 and draws < _MOST_DRAWS and _is_dead(arguments, log):
        shutil.rmtree(_value(arguments, "--out"), ignore_errors=True)
        exit_code = run_command(_with_seed(arguments, draws), log)
        draws += 1
    seconds = time.perf_counter() - start
    dead = exit_code != 0 and _is_dead(arguments, log)
    return JobResult(exit_code, seconds, draws=draws, dead=dead)


def _is_dead(arguments: tuple[str, ...], log: Path) -> bool:
    """Whether a training has ended because nothing is left to learn with."""
    return arguments[0] == "train" and "the network is dead" in log.read_text(errors="replace")


def _value(arguments: tuple[str, ...], option: str) -> str:
    return arguments[arguments.index(option) + 1]


def _with_seed(arguments: tuple[str, ...], draw: int) -> list[str]:
    """The arguments without --resume, with a seed of no other training."""
    seed = str(_REDRAWN * draw + int(_value(arguments, "--seed")))
    place = arguments.index("--seed") + 1
    return [one for one in (*arguments[:place], seed, *arguments[place + 1 :]) if one != "--resume"]


def _run_logged(run: Callable[[list[str]], int], arguments: list[str], log: Path) -> int:
    """Call ``run`` with the output of the process, that of C libraries included, in the log."""
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    try:
        return run(arguments)
    except Exception:
        traceback.print_exc()  # the worker goes on with the next job
        return 1
    finally:
        if resident_bytes() > _MUCH_MEMORY:
            release_programs()  # each data set has others
        sys.stdout.flush()
        sys.stderr.flush()


def release_programs() -> None:
    """Forget all compiled programs, and give their memory back to the system."""
    import jax

    jax.clear_caches()
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc
    if trim is not None:
        trim(0)


def resident_bytes() -> int:
    """Memory of this process; 0 where the system does not tell."""
    statistics = Path("/proc/self/statm")  # of Linux
    if not statistics.exists():
        return 0
    return int(statistics.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
