"""Jobs of a study: one command line each, its output, and the record of how it was made."""

import hashlib
import json
import shlex
import shutil
import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from contactgraph.data import atomic_write

Options = tuple[str, ...]
"""Options of a command."""


@dataclass(frozen=True)
class Variant:
    """A variation of a command."""

    slug: str
    """Part of file names."""
    name: str
    options: Options = ()


PLAIN = Variant("", "")
"""The command as it is."""


@dataclass(frozen=True)
class Job:
    """One ``contactgraph`` command. Paths are relative to the study's folder, where it is run."""

    output: str
    """The file or folder that exists once the command has succeeded."""
    arguments: tuple[str, ...]
    """The command line after ``contactgraph``."""
    group: str
    """Jobs of one group take about equally long and use the same compiled programs."""
    needs: tuple["Job", ...] = ()
    """Jobs whose outputs this one reads."""
    extra_outputs: tuple[str, ...] = ()
    """Further files that the command writes and that jobs which need it read."""
    checkpoints: str = ""
    """Glob pattern of files in the output from which ``--resume`` continues; "": none."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Every file and folder that the command leaves."""
        return (self.output, *self.extra_outputs)

    @property
    def command(self) -> str:
        """The command line as a user types it."""
        return f"contactgraph {shlex.join(self.arguments)}"

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the command and of the commands that made its inputs."""
        parts = [list(self.arguments), [job.fingerprint for job in self.needs]]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Measurement:
    """A job whose output is a JSON object of numbers, and the condition that they describe."""

    condition: Any
    """A frozen dataclass; its fields are the labels of the numbers in ``results.json``."""
    seed: int
    job: Job


def in_dependency_order(wanted: Iterable[Job]) -> list[Job]:
    """The jobs and all that they need, each once and after its inputs.

    The order is otherwise the given one, so that inputs are made just before their first use.
    """
    ordered: dict[str, Job] = {}  # by output: comparing jobs would compare all their inputs

    def add(job: Job) -> None:
        if job.output in ordered:
            return
        for needed in job.needs:
            add(needed)
        ordered[job.output] = job

    for job in wanted:
        add(job)
    return list(ordered.values())


@dataclass(frozen=True)
class JobRecords:
    """The files ``OUTPUT.made.json`` in a study's folder.

    A job is done if its record was written by the same command and version and its output exists.
    """

    folder: Path
    version: str
    """Version of the package."""

    def seconds(self, job: Job) -> float | None:
        """Wall time of a finished job, s; None if it has to be run."""
        exists = self._was_done(job) and (self.folder / job.output).exists()
        return float(self._read(job)["seconds"]) if exists else None

    def begin(self, job: Job) -> tuple[str, ...]:
        """Prepare the output folder; the arguments to run the job with.

        The output of another command is removed. An interrupted training of the same command is
        resumed from its checkpoint.
        """
        output = self.folder / job.output
        resumable = job.checkpoints and any(output.glob(job.checkpoints))
        if resumable and self._matches(job, self._read(job)):
            self._write(job, finished=False, seconds=0.0)
            return (*job.arguments, "--resume")
        if output.is_dir():
            shutil.rmtree(output)
        output.unlink(missing_ok=True)
        output.parent.mkdir(parents=True, exist_ok=True)
        self._write(job, finished=False, seconds=0.0)
        return job.arguments

    def finish(self, job: Job, seconds: float, draws: int = 1) -> None:
        """Mark the job as done, after this many draws of its seed."""
        self._write(job, finished=True, seconds=seconds, draws=draws)

    def refuse(self, job: Job, reason: str, seconds: float, draws: int) -> None:
        """Mark a training as one that has only dead networks, so that it is not tried again."""
        self._write(job, finished=False, seconds=seconds, draws=draws, refused=reason)

    def refusal(self, job: Job) -> str | None:
        """Why a job is not to be tried again; None if it may be."""
        record = self._read(job)
        return record.get("refused") if self._matches(job, record) else None

    def restore(self, jobs: Iterable[Job], kept: Path) -> None:
        """Records and outputs that a ``results.json`` holds of jobs whose own files are gone.

        Those of another command, other inputs or another version are left out.
        """
        try:
            stored = json.loads(kept.read_text())
        except (OSError, ValueError):
            return
        if stored.get("versions", {}).get("contactgraph") != self.version:
            return
        values = {each.get("fingerprint"): each["values"] for each in stored.get("cells", ())}
        costs = {each: {} for each in values} | stored.get("jobs", {})
        for job in jobs:
            output = self.folder / job.output
            output.parent.mkdir(parents=True, exist_ok=True)
            if job.fingerprint in values and not output.exists():
                with atomic_write(output) as temporary:
                    temporary.write_text(json.dumps(values[job.fingerprint]))
            if job.fingerprint in costs and not self._matches(job, self._read(job)):
                cost = {"seconds": 0.0, "draws": 1} | costs[job.fingerprint]
                if "refused" in cost:
                    self.refuse(job, cost["refused"], cost["seconds"], cost["draws"])
                else:
                    self.finish(job, cost["seconds"], cost["draws"])

    def costs(self, jobs: Iterable[Job]) -> dict[str, dict[str, Any]]:
        """Wall time (s) and draws by fingerprint of each job done, whose output may be gone, and
        why it is refused, if so."""
        tried = [job for job in jobs if self._was_done(job) or self.refusal(job)]
        records = {job.fingerprint: {"draws": 1} | self._read(job) for job in tried}
        names = ("seconds", "draws", "refused")
        return {
            of_job: {name: record[name] for name in names if name in record}
            for of_job, record in records.items()
        }

    def redrawn(self, jobs: Iterable[Job]) -> dict[str, int]:
        """By command, the networks that were dead and drawn again."""
        draws = {job.command: int(self._read(job).get("draws", 1)) for job in jobs}
        return {command: count - 1 for command, count in draws.items() if count > 1}

    def log_path(self, job: Job) -> Path:
        """The file that holds the command's output while it runs, and after a failure."""
        return self.folder / f"{job.output}.log"

    def _was_done(self, job: Job) -> bool:
        record = self._read(job)
        return self._matches(job, record) and record.get("finished") is True

    def _path(self, job: Job) -> Path:
        return self.folder / f"{job.output}.made.json"

    def _matches(self, job: Job, record: dict[str, Any]) -> bool:
        expected = (job.fingerprint, self.version)
        return (record.get("fingerprint"), record.get("version")) == expected

    def _read(self, job: Job) -> dict[str, Any]:
        try:
            record = json.loads(self._path(job).read_text())
        except (OSError, ValueError):
            return {}
        return record if isinstance(record, dict) else {}

    def _write(self, job: Job, finished: bool, seconds: float, draws: int = 1, **more: str) -> None:
        record = {
            "command": job.command,
            "fingerprint": job.fingerprint,
            "version": self.version,
            "finished": finished,
            "seconds": round(seconds, 3),
            "draws": draws,
            **more,
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        }
        with atomic_write(self._path(job)) as temporary:
            temporary.write_text(json.dumps(record, indent=2) + "\n")
