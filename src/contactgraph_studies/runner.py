"""Makes the cells of a study that are not there yet, several at a time, in order of need."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from contactgraph.parallel import Executor, Outcome
from contactgraph_studies.cell import Cell
from contactgraph_studies.errand import Ended, errand_of
from contactgraph_studies.parcel import unpack
from contactgraph_studies.record import Records

_CELLS_A_WORKER = 25
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
    executor: Executor,
    begin: Callable[[], Callable[[Any], Ended]],
    on_step: Callable[[Standing], None],
) -> list[Failure]:
    """Make every cell that is not done; the failures, none where all went well.

    ``cells`` in order, each behind those it needs (`in_order`). The executor's workers carry out
    their errands, as ``begin`` tells them. A cell that fails takes only those with it that need it.
    ``on_step`` is called after every cell. Ctrl-C ends the workers; what is half done is taken up
    by the next call.
    """
    schedule = _Schedule(cells, records)
    if not schedule.waiting:
        return []
    made: dict[int, Cell] = {}
    kinds: dict[int, list[str]] = {}
    with executor.pool(begin, len(schedule.waiting), _CELLS_A_WORKER) as pool:
        while schedule.waiting or schedule.running:
            for worker in pool.idle():
                cell = schedule.next(kinds.setdefault(worker, []))
                if cell is None:
                    break
                kinds[worker].append(cell.kind)
                made[worker] = cell
                pool.submit(worker, errand_of(cell, records, executor.shares_files))
            for outcome in pool.wait():
                cell = made.pop(outcome.worker)
                seconds, failure = _taken(cell, records, outcome)
                schedule.finished(cell, seconds, failure)
                left = schedule.seconds_left(executor.workers)
                on_step(Standing(schedule.done, len(cells), left, cell, failure))
    return schedule.failures


def _taken(cell: Cell, records: Records, outcome: Outcome) -> tuple[float, Failure | None]:
    """Put the outcome where it belongs: how long it took, or why there is none."""
    log, ended = records.log_path(cell), outcome.result
    if ended is not None and ended.said:
        log.write_text(ended.said)
    if ended is None or ended.code != 0:
        reason = outcome.lost or f"exit code {ended.code}"
        return 0.0, Failure(cell, f"{reason}; {_last_line(log)}")
    unpack(ended.files, records.folder)
    records.finish(cell, ended.seconds)
    log.unlink(missing_ok=True)
    return ended.seconds, None


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").split("\n") if log.exists() else []
    said = [line.strip() for line in lines if line.strip()]
    return said[-1] if said else f"it said nothing in {log}"


class _Schedule:
    """Which cell is next."""

    def __init__(self, cells: Sequence[Cell], records: Records) -> None:
        took = {cell.output: records.seconds(cell) for cell in cells}
        stale: set[str] = set()
        for cell in cells:  # what is made from something that is made anew is made anew
            if took[cell.output] is None or any(need.output in stale for need in cell.needs):
                stale.add(cell.output)
        self.waiting = [cell for cell in cells if cell.output in stale]
        self.running: dict[str, Cell] = {}
        self.failures: list[Failure] = []
        self._made = {cell.output for cell in cells} - stale
        self._lost: set[str] = set()
        self._seconds: dict[str, list[float]] = {}
        for cell in cells:
            seconds = took[cell.output]
            if cell.output in self._made and seconds is not None:
                self._seconds.setdefault(cell.kind, []).append(seconds)

    @property
    def done(self) -> int:
        """Cells that are made, or cannot be."""
        return len(self._made) + len(self._lost)

    def next(self, kinds: Sequence[str]) -> Cell | None:
        """A cell whose inputs are there, if there is one.

        The first of ``kinds``, for which the worker that asks has compiled its programs, if there
        is one; else the first of all.
        """
        ready = [cell for cell in self.waiting if all(n.output in self._made for n in cell.needs)]
        if not ready:
            return None
        cell = next((cell for cell in ready if cell.kind in kinds), ready[0])
        self.waiting.remove(cell)
        self.running[cell.output] = cell
        return cell

    def finished(self, cell: Cell, seconds: float, failure: Failure | None) -> None:
        """The cell is made, or could not be."""
        del self.running[cell.output]
        if failure is None:
            self._made.add(cell.output)
            self._seconds.setdefault(cell.kind, []).append(seconds)
        else:
            self._lose(failure)

    def seconds_left(self, at_a_time: int) -> float | None:
        """By the cells of the same kind done so far; None before the first."""
        every = [seconds for of_kind in self._seconds.values() for seconds in of_kind]
        if not every:
            return None
        usual = statistics.fmean(every)
        left = 0.0
        for cell in [*self.waiting, *self.running.values()]:
            known = self._seconds.get(cell.kind)
            left += statistics.fmean(known) if known else usual
        return left / at_a_time

    def _lose(self, failure: Failure) -> None:
        """The cell, and whatever needs it, cannot be made."""
        self.failures.append(failure)
        self._lost.add(failure.cell.output)
        for cell in list(self.waiting):  # in order of need, so one pass finds all
            lost = [need.output for need in cell.needs if need.output in self._lost]
            if lost:
                self.waiting.remove(cell)
                self._lost.add(cell.output)
                self.failures.append(Failure(cell, f"not begun: it needs {lost[0]}"))
