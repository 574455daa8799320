"""Makes the cells of a study that are not there yet, several at a time, in order of need."""

import statistics
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from contactgraph.reproduce.cell import Cell
from contactgraph.reproduce.record import Records
from contactgraph.reproduce.worker_process import WorkerProcess

_CELLS_A_PROCESS = 25
"""A process keeps every program that it has compiled: 2.7 GB after 60 cells, by measurement."""


@dataclass(frozen=True)
class Failure:
    """A cell that could not be made."""

    cell: Cell
    reason: str
    """One line."""


@dataclass(frozen=True)
class Standing:
    """How far the study has come."""

    done: int
    total: int
    seconds_left: float | None
    """By the cells of the same kind done so far; None before the first."""
    last: Cell
    failure: Failure | None
    """Of the last cell."""


def run_cells(
    cells: Sequence[Cell],
    records: Records,
    workers: Sequence[Sequence[str]],
    on_step: Callable[[Standing], None],
) -> list[Failure]:
    """Make every cell that is not done; the failures, none where all went well.

    ``cells`` in order, each behind those it needs (`in_order`). ``workers`` are the commands that
    start the worker processes, one for every cell made at a time. A cell that fails takes only
    those with it that need it. ``on_step`` is called after every cell, by one thread at a time.
    Ctrl-C ends the workers; what is half done is taken up by the next call.
    """
    schedule = _Schedule(cells, records, len(workers), on_step)
    processes = [WorkerProcess(command, records.folder) for command in workers]
    threads = [
        threading.Thread(target=_work, args=(schedule, process, records), daemon=True)
        for process in processes
    ]
    for thread in threads:
        thread.start()
    try:
        for thread in threads:
            thread.join()
    finally:
        schedule.stop()
        for process in processes:
            process.stop()
        for thread in threads:
            thread.join()
    if schedule.fault is not None:
        raise schedule.fault
    return schedule.failures


def _work(schedule: "_Schedule", process: WorkerProcess, records: Records) -> None:
    kinds: list[str] = []
    try:
        while (cell := schedule.next(kinds)) is not None:
            log = records.log_path(cell)
            answer = process.run(records.begin(cell), log)
            if answer is not None and answer.code == 0:
                records.finish(cell, answer.seconds)
                log.unlink(missing_ok=True)
                schedule.finished(cell, answer.seconds, None)
            else:
                died = "its process died" if answer is None else f"exit code {answer.code}"
                schedule.finished(cell, 0.0, Failure(cell, f"{died}; {_last_line(log)}"))
            kinds.append(cell.kind)
            if answer is None or len(kinds) >= _CELLS_A_PROCESS:
                process.close()
                kinds.clear()
    except BaseException as fault:  # told to the caller, whose thread is another
        schedule.fault = fault
        schedule.stop()
    finally:
        process.close()


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").split("\n") if log.exists() else []
    said = [line.strip() for line in lines if line.strip()]
    return said[-1] if said else f"it said nothing in {log}"


class _Schedule:
    """Which cell is next; shared by the threads."""

    def __init__(
        self,
        cells: Sequence[Cell],
        records: Records,
        at_a_time: int,
        on_step: Callable[[Standing], None],
    ) -> None:
        took = {cell.output: records.seconds(cell) for cell in cells}
        stale: set[str] = set()
        for cell in cells:  # what is made from something that is made anew is made anew
            if took[cell.output] is None or any(need.output in stale for need in cell.needs):
                stale.add(cell.output)
        self._waiting = [cell for cell in cells if cell.output in stale]
        self._done = {cell.output for cell in cells} - stale
        self._lost: set[str] = set()
        self._running: dict[str, Cell] = {}
        self._total, self._at_a_time, self._on_step = len(cells), at_a_time, on_step
        self._seconds: dict[str, list[float]] = {}
        for cell in cells:
            seconds = took[cell.output]
            if cell.output in self._done and seconds is not None:
                self._seconds.setdefault(cell.kind, []).append(seconds)
        self._stopped = False
        self._changed = threading.Condition()
        self.failures: list[Failure] = []
        self.fault: BaseException | None = None

    def next(self, kinds: Sequence[str]) -> Cell | None:
        """A cell whose inputs are there; waits for one. None: there is nothing more.

        The first of ``kinds``, for which the process that asks has compiled its programs, if there
        is one; else the first of all.
        """
        with self._changed:
            while not self._stopped and self._waiting:
                ready = [
                    cell
                    for cell in self._waiting
                    if all(need.output in self._done for need in cell.needs)
                ]
                if ready:
                    cell = next((cell for cell in ready if cell.kind in kinds), ready[0])
                    self._waiting.remove(cell)
                    self._running[cell.output] = cell
                    return cell
                self._changed.wait()
            return None

    def finished(self, cell: Cell, seconds: float, failure: Failure | None) -> None:
        """The cell is made, or could not be."""
        with self._changed:
            if self._stopped:
                return  # a process that was ended is no failure of its cell
            del self._running[cell.output]
            if failure is None:
                self._done.add(cell.output)
                self._seconds.setdefault(cell.kind, []).append(seconds)
            else:
                self._lose(failure)
            self._changed.notify_all()
            done = self._total - len(self._waiting) - len(self._running)
            left = self._seconds_left()
            self._on_step(Standing(done, self._total, left, cell, failure))

    def stop(self) -> None:
        """Hand out nothing more."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def _lose(self, failure: Failure) -> None:
        """The cell, and whatever needs it, cannot be made."""
        self.failures.append(failure)
        self._lost.add(failure.cell.output)
        for cell in list(self._waiting):  # in order of need, so one pass finds all
            lost = [need.output for need in cell.needs if need.output in self._lost]
            if lost:
                self._waiting.remove(cell)
                self._lost.add(cell.output)
                self.failures.append(Failure(cell, f"not begun: it needs {lost[0]}"))

    def _seconds_left(self) -> float | None:
        every = [seconds for of_kind in self._seconds.values() for seconds in of_kind]
        if not every:
            return None
        usual = statistics.fmean(every)
        left = 0.0
        for cell in [*self._waiting, *self._running.values()]:
            known = self._seconds.get(cell.kind)
            left += statistics.fmean(known) if known else usual
        return left / self._at_a_time
