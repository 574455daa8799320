"""Wishes of a page: JSON messages, checked before anything acts on them."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.files import JsonFields, parse_json

SENSORS = ("exact", "broken", "blind")
"""The contact sensor as it is, with false alarms and misses, or without readings."""
SWITCHES = ("auto", "on", "off")
"""A task's switch by the plan, or by hand."""
SPEEDS = (0.1, 4.0)
"""Least and largest speed, in units of real time."""
_FARTHEST = 100.0
"""m; limit of coordinates, beyond which nothing is drawn."""


@dataclass(frozen=True, eq=False)
class MoveGoal:
    """The goal is dragged."""

    goal: np.ndarray
    """[D] m"""
    number: int
    """Of the message; frames repeat the last one that a plan knows of."""


@dataclass(frozen=True, eq=False)
class Pull:
    """A body is pulled by hand to a place, until `Release`."""

    node: int
    to: np.ndarray
    """[D] m"""


@dataclass(frozen=True)
class Release:
    """The hand lets go."""


@dataclass(frozen=True)
class SetSensor:
    """The contact sensor is broken, blinded or mended: one of `SENSORS`."""

    sensor: str


@dataclass(frozen=True)
class SetSwitch:
    """A task's switch is operated by hand, or left to the plan: one of `SWITCHES`."""

    switch: str


@dataclass(frozen=True)
class Pause:
    """Time stands still, or goes on."""

    paused: bool


@dataclass(frozen=True)
class SingleStep:
    """One step, then a pause."""


@dataclass(frozen=True)
class SetSpeed:
    """Slower or faster than real time."""

    speed: float


@dataclass(frozen=True)
class Reset:
    """The episode ends; the next one begins."""


@dataclass(frozen=True)
class StageChoice:
    """A model in a task, with a number of distractors."""

    model: str
    task: str
    distractors: int = 0


Wish = (
    MoveGoal
    | Pull
    | Release
    | SetSensor
    | SetSwitch
    | Pause
    | SingleStep
    | SetSpeed
    | Reset
    | StageChoice
)


def read_wish(message: str | bytes) -> Wish:
    """The wish of a message; raises `InvalidInputError`, with one line, for anything else."""
    if isinstance(message, bytes):
        raise InvalidInputError("a message must be text")
    try:
        content = parse_json(message)
    except (ValueError, RecursionError) as error:
        raise InvalidInputError("a message must be JSON") from error
    if not isinstance(content, dict):
        raise InvalidInputError("a message must be a JSON object")
    given = JsonFields("message", content)
    name = given.text("wish")
    match name:
        case "goal":
            return MoveGoal(_place(given, "goal"), given.count("number", 0))
        case "pull":
            return Pull(given.count("node", 0), _place(given, "to"))
        case "release":
            return Release()
        case "sensor":
            return SetSensor(_one_of(given, "sensor", SENSORS))
        case "switch":
            return SetSwitch(_one_of(given, "switch", SWITCHES))
        case "pause":
            return Pause(given.truth("paused"))
        case "step":
            return SingleStep()
        case "speed":
            return SetSpeed(float(np.clip(given.numbers("speed", ()), *SPEEDS)))
        case "reset":
            return Reset()
        case "stage":
            return StageChoice(
                given.text("model"), given.text("task"), given.count("distractors", 0)
            )
    raise InvalidInputError("message: field 'wish' names no wish")


def _place(given: JsonFields, name: str) -> np.ndarray:
    """[D] m"""
    place = given.numbers(name, (None,))
    if np.abs(place).max() > _FARTHEST:
        raise InvalidInputError(f"message: field {name!r} must be within {_FARTHEST:g} m")
    return place


def _one_of(given: JsonFields, name: str, valid: tuple[str, ...]) -> str:
    value = given.text(name)
    if value not in valid:
        raise InvalidInputError(f"message: field {name!r} must be one of {', '.join(valid)}")
    return value
