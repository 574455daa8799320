"""Work tried by one process and told to another: answers, mistakes and faults as plain values."""

import traceback
from dataclasses import dataclass
from typing import Any

from contactgraph.data import InvalidInputError
from contactgraph.parallel.engine import Begin


@dataclass(frozen=True)
class _Mistake:
    """`InvalidInputError`."""

    text: str


@dataclass(frozen=True)
class _Fault:
    """Any other exception: its traceback."""

    text: str


def attempt(begin: Begin, unit: Any) -> Any:
    """What the work answers to the unit, or raises, as a value that can be sent."""
    try:
        return begin()(unit)
    except InvalidInputError as mistake:
        return _Mistake(str(mistake))
    except Exception:
        return _Fault(traceback.format_exc())


def told(answer: Any) -> Any:
    """What `attempt` has returned elsewhere.

    Raises `InvalidInputError` where the work did, and `RuntimeError` with the traceback of
    whatever else it raised.
    """
    if isinstance(answer, _Mistake):
        raise InvalidInputError(answer.text)
    if isinstance(answer, _Fault):
        raise RuntimeError(answer.text)
    return answer
