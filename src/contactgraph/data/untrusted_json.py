"""JSON from files of anybody's: numbers are finite, and versions are those that we know."""

import json
from collections.abc import Mapping
from typing import Any

from contactgraph.data.errors import InvalidInputError


def parse_json(text: str) -> Any:
    """The content of a JSON text; raises `ValueError` also for NaN and infinity."""
    return json.loads(text, parse_constant=_refuse_constant)


def check_version(field: str, content: Mapping[str, Any], version: int) -> None:
    """Raises `InvalidInputError` where ``format_version`` is another one.

    ``field`` is what the message calls a field, with the file's name, e.g. ``"a.json: field"``.
    """
    found = content.get("format_version")
    if found != version or isinstance(found, bool):
        raise InvalidInputError(f"{field} 'format_version' must be {version}, found {found!r}")


def _refuse_constant(name: str) -> None:
    raise ValueError(f"numbers must be finite, found {name}")
