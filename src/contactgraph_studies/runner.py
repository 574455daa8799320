"""Execution of a study's jobs in dependency order, several at a time."""

import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from contactgraph.cli.output import progress
from contactgraph.parallel import Executor, Outcome
from contactgraph_studies.execution import JobResult, create_worker, prepare, write_bundle
from contactgraph_studies.job import Job, JobRecords


@dataclass(frozen=True)
class Failure:
    """A job that failed, or was not started because one that it needs failed."""

    job: Job
    reason: str
    """One line."""
    started: bool = True


@dataclass(frozen=True)
class Progress:
    """The state of a study after a job has ended."""

    done: int
    total: int
    seconds_left: float | None
    """Estimate from the finished jobs of the same group; None before the first."""
    last: Job
    failure: Failure | None
    """Of the last job."""


def run_jobs(
    jobs: Sequence[Job],
    records: JobRecords,
    executor: Executor,
    initializer: Callable[[], Callable[[Any], JobResult]],
    on_progress: Callable[[Progress], None],
    seconds: float = math.inf,
) -> list[Failure]:
    """Run every job that is not done, and that one needs which is not; the failures.

    ``jobs`` are in dependency order. ``initializer`` is called once in each worker process and
    returns the function that executes a job there. A failed job stops only the jobs that need it.
    After ``seconds`` none is started any more. A training with dead networks alone is not repeated.
    Ctrl-C ends the workers; the next call continues the study.
    """
    schedule, until = _Schedule(jobs, records), time.monotonic() + seconds
    if not schedule.waiting:
        return schedule.failures
    running: dict[int, Job] = {}
    groups: dict[int, list[str]] = {}
    with executor.pool(initializer, len(schedule.waiting)) as pool:
        while (schedule.waiting and time.monotonic() < until) or running:
            for worker in pool.idle() if time.monotonic() < until else ():
                job = schedule.next(groups.setdefault(worker, []))
                if job is None:
                    break
                groups[worker].append(job.group)
                running[worker] = job
                pool.submit(worker, prepare(job, records, executor.shares_files))
            for outcome in pool.wait():
                job = running.pop(outcome.worker)
                seconds, failure = _store(job, records, outcome)
                schedule.end(job, seconds, failure)
                left = schedule.seconds_left(list(running.values()), executor.workers)
                on_progress(Progress(schedule.done, len(jobs), left, job, failure))
    return schedule.failures


def run_reported(
    jobs: Sequence[Job], records: JobRecords, executor: Executor, seconds: float = math.inf
) -> list[Failure]:
    """Run jobs, with progress and failures on stderr; see `run_jobs`."""

    def report(failure: Failure) -> None:
        command = failure.job.command
        print(f"failed: {command} ({failure.reason})", file=sys.stderr, flush=True)

    records.folder.mkdir(parents=True, exist_ok=True)
    with progress("jobs", len(jobs)) as bar:

        def on_progress(now: Progress) -> None:
            if now.failure is not None:
                report(now.failure)
            left = now.seconds_left
            estimate = "" if left is None else f"about {max(1, round(left / 60))} min left; "
            bar.advance(now.done, f"{estimate}{now.last.group}")

        failures = run_jobs(jobs, records, executor, create_worker, on_progress, seconds)
    for failure in failures:
        if not failure.started:
            report(failure)
    return failures


def _store(job: Job, records: JobRecords, outcome: Outcome) -> tuple[float, Failure | None]:
    """Write the outputs or the log of a job that has ended; its wall time, s, and its failure."""
    log, result = records.log_path(job), outcome.result
    if result is not None and result.log:
        log.write_text(result.log)
    if result is None or result.exit_code != 0:
        reason = f"{outcome.lost or f'exit code {result.exit_code}'}; {last_line(log)}"
        if result is not None and result.dead:
            records.refuse(job, reason, result.seconds, result.draws)
        return 0.0, Failure(job, reason)
    write_bundle(result.files, records.folder)
    records.finish(job, result.seconds, result.draws)
    log.unlink(missing_ok=True)
    return result.seconds, None


def last_line(log: Path) -> str:
    """The last line that a command printed."""
    lines = log.read_text(errors="replace").split("\n") if log.exists() else []
    printed = [line.strip() for line in lines if line.strip()]
    return printed[-1] if printed else f"it printed nothing to {log}"


def reason_missing(job: Job, records: JobRecords) -> str | None:
    """The reason why a job has no result; None if it has."""
    if records.seconds(job) is not None:
        return None
    for needed in job.needs:
        reason = reason_missing(needed, records)
        if reason is not None:
            return reason
    log = records.log_path(job)
    if not log.exists():
        return "not measured yet"
    return f"not finished: {job.command} ({last_line(log)})"


class _Schedule:
    """The jobs that still have to run, and the times of those that have run."""

    def __init__(self, jobs: Sequence[Job], records: JobRecords) -> None:
        seconds = {job.output: records.seconds(job) for job in jobs}
        self.waiting: list[Job] = []
        self.failures: list[Failure] = []
        self._finished: set[str] = set()
        self._lost: set[str] = set()
        self._seconds: dict[str, list[float]] = {}
        asked = {job.output for job in jobs} - {need.output for job in jobs for need in job.needs}
        for job in reversed(jobs):
            if seconds[job.output] is None and job.output in asked:
                asked.update(need.output for need in job.needs)
                self.waiting.insert(0, job)
            else:  # done, or needed by nothing that is left to do
                self._succeed(job, seconds[job.output])
        for job in list(self.waiting):
            refusal = records.refusal(job)
            if refusal is not None:
                self.waiting.remove(job)
                self.end(job, 0.0, Failure(job, refusal))

    @property
    def done(self) -> int:
        """Jobs that have succeeded, or cannot."""
        return len(self._finished) + len(self._lost)

    def next(self, groups: Sequence[str]) -> Job | None:
        """A job whose inputs exist; preferably of ``groups``, whose programs the worker has."""
        ready = [job for job in self.waiting if all(n.output in self._finished for n in job.needs)]
        if not ready:
            return None
        job = next((job for job in ready if job.group in groups), ready[0])
        self.waiting.remove(job)
        return job

    def end(self, job: Job, seconds: float, failure: Failure | None) -> None:
        """Account for a job that has run; after a failure the jobs that need it are lost, too."""
        if failure is None:
            self._succeed(job, seconds)
            return
        self.failures.append(failure)
        self._lost.add(job.output)
        for other in list(self.waiting):  # in dependency order, so one pass is enough
            lost = [need.output for need in other.needs if need.output in self._lost]
            if lost:
                self.waiting.remove(other)
                self._lost.add(other.output)
                self.failures.append(Failure(other, f"not started: it needs {lost[0]}", False))

    def seconds_left(self, running: Sequence[Job], at_a_time: int) -> float | None:
        """Estimated wall time until the end, s; None before any job has finished."""
        every = [seconds for group in self._seconds.values() for seconds in group]
        if not every:
            return None
        usual = statistics.fmean(every)
        left = 0.0
        for job in [*self.waiting, *running]:
            known = self._seconds.get(job.group)
            left += statistics.fmean(known) if known else usual
        return left / at_a_time

    def _succeed(self, job: Job, seconds: float | None) -> None:
        self._finished.add(job.output)
        if seconds is not None:
            self._seconds.setdefault(job.group, []).append(seconds)
