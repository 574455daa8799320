"""The contract of an engine: units of work are handed out, and outcomes come back.

A unit is any plain value, and work answers it. An engine knows nothing of what units are about, and
decides nothing but which machine takes one; what is next, and what becomes of an answer, is for its
caller to say.
"""

from collections.abc import Callable, Generator, Hashable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

Unit = TypeVar("Unit", bound=Hashable)
Answer = TypeVar("Answer")
Work = Callable[[Any], Any]
Begin = Callable[[], Work]
"""Called once by whoever does the work, for the work it then does."""


@dataclass(frozen=True)
class Outcome:
    """What became of a unit."""

    worker: int
    unit: Any
    answer: Any = None
    lost: str | None = None
    """Why there is no answer: whoever was at it is gone. One line."""


class Crew(Protocol):
    """Workers that wait for units of one kind of work."""

    def idle(self) -> Sequence[int]:
        """The workers that would take a unit now.

        A number stands for one worker for as long as it lives, and so for what it has learned
        (programs that it has compiled); an engine that cannot tell its workers apart numbers the
        places for them.
        """

    def give(self, worker: int, unit: Any) -> None:
        """Have an idle worker begin with a unit."""

    def wait(self) -> Sequence[Outcome]:
        """Outcomes since the last call, at least one; waits for it.

        Raises `InvalidInputError` as the work does, and `RuntimeError` with the traceback of
        whatever else the work raises.
        """


class Engine(Protocol):
    """Something that has workers."""

    @property
    def workers(self) -> int:
        """Units that are done at a time; may change."""

    @property
    def sees_files(self) -> bool:
        """Whether workers read and write the very files that are seen here."""

    def crew(
        self, begin: Begin, units: int, units_a_worker: int = 0
    ) -> AbstractContextManager[Crew]:
        """Workers for so many units at most. They end with the context, whatever they are at.

        ``begin``, units and answers are sent from one to the other: they are made of plain values,
        and of functions and classes that a module has at its top. A worker is replaced by another
        after ``units_a_worker`` units, if that is not 0: programs keep what they have compiled.
        """


def answers_in_order(
    engine: Engine, begin: Callable[[], Callable[[Unit], Answer]], units: Sequence[Unit]
) -> Generator[Answer, None, None]:
    """What the work answers to each of the units, in their order. Workers end with the iterator.

    Raises as `Crew.wait` does, and `RuntimeError` where a worker is lost for good.
    """
    waiting = list(reversed(units))
    done: dict[Unit, Answer] = {}
    with engine.crew(begin, len(units)) as crew:
        for unit in units:
            while unit not in done:
                for worker in crew.idle()[: len(waiting)]:
                    crew.give(worker, waiting.pop())
                for outcome in crew.wait():
                    if outcome.lost is not None:
                        raise RuntimeError(f"{outcome.unit}: {outcome.lost}")
                    done[outcome.unit] = outcome.answer
            yield done.pop(unit)
