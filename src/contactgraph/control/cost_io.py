"""Cost files: one JSON object with a learned cost, its task nodes, and how it was learned.

A file is also made for people: it states in words what it minimises and in which units, a matrix
has a row a line, and numbers have as many digits as give the same number back.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from contactgraph.control.contact_cost import KINDS
from contactgraph.control.learned_cost import (
    ROUNDING,
    LearnedContact,
    LearnedCost,
    TaskNode,
)
from contactgraph.data import InvalidInputError, atomic_write
from contactgraph.data.files import JsonFields, read_json_fields

FORMAT = "contactgraph-cost"
VERSION = 2
_SIZE_LIMIT = 20_000_000
"""Bytes."""
_WORDS = {
    "cost": "sum over steps of (x - goal)^T Q (x - goal) + u^T R u, and of contacts",
    "x": "for each kept node, in order: its D positions [m], then its D velocities [m/s]",
    "contacts": "weight times the probability that it is not as its kind says, and where a contact "
    "is wanted times 1 + (distance of the centres / 1 m)^2",
    "goal": "the same place [m] for all kept nodes, at rest",
    "units": "Q: 1/m^2, s/m^2 and s^2/m^2; R: 1/N^2; goal: m",
    "scale": "a cost is known up to a factor; here the mean of R's diagonal is 1/N^2",
}


def write_cost(path: str | Path, cost: LearnedCost, made: Mapping[str, Any] | None = None) -> None:
    """Write a cost to ``path``, atomically: a reader gets the old file or the whole new one.

    ``made`` is anything JSON can hold. The same cost gives the same bytes. Raises
    `InvalidInputError` where `read_cost` would refuse it, ``made`` is not JSON, or the folder
    cannot be written to.
    """
    path = Path(path)
    content = {
        "format": FORMAT,
        "format_version": VERSION,
        "in_words": _WORDS,
        "dimension": int(cost.goal.shape[0]),
        "kept_nodes": list(cost.kept_nodes),
        "nodes": list(cost.order),
        "goal": _numbers(cost.goal),
        "Q": _numbers(cost.Q),
        "R": _numbers(cost.R),
        "task_nodes": [
            {
                "name": each.name,
                "kept": each.kept,
                "reason": each.reason,
                "actuated": each.actuated,
                "trajectories": each.trajectories,
                "active_trajectories": each.active_trajectories,
                "first_contact_time_s": each.first_contact_time,
            }
            for each in cost.task_nodes
        ],
        "contacts": [
            {"kind": each.kind, "nodes": list(each.nodes), "weight": _numbers(each.weight)}
            for each in cost.contacts
        ],
        "made": dict(made or {}),
        "history": {"imitation": _numbers(cost.imitation_loss)},
    }
    _content(JsonFields(str(path), content))
    try:
        text = _text(content) + "\n"
    except (TypeError, ValueError, RecursionError) as error:
        raise InvalidInputError(f"{path}: made must hold only JSON values ({error})") from error
    if json.loads(text)["made"] != content["made"]:
        raise InvalidInputError(f"{path}: made must hold only JSON values (and texts as keys)")
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_cost(path: str | Path) -> LearnedCost:
    """Read a cost that `write_cost` has written, in JAX's default precision.

    Nothing in the file is executed. Raises `InvalidInputError` naming file and field for any
    fault in it.
    """
    return describe_cost(path)[0]


def describe_cost(path: str | Path) -> tuple[LearnedCost, dict[str, Any]]:
    """The cost, and how it was made: model, demonstrations, recipe, seed, seconds, versions, …

    Raises `InvalidInputError` as `read_cost` does.
    """
    fields = read_json_fields(Path(path), "a cost file", FORMAT, VERSION, _SIZE_LIMIT)
    return _content(fields)


def _content(fields: JsonFields) -> tuple[LearnedCost, dict[str, Any]]:
    """The checked content. Fields that are not known are left alone."""
    names = fields.names("kept_nodes")
    dimension = fields.count("dimension", 1)
    goal = fields.numbers("goal", (dimension,))
    return (
        LearnedCost(
            Q=jnp.asarray(_of_steps(fields, "Q", 2 * dimension * len(names), semi=True)),
            R=jnp.asarray(_of_steps(fields, "R")),
            goal=jnp.asarray(goal),
            nodes=jnp.asarray(fields.indices("nodes", len(names)), jnp.int32),
            kept_nodes=names,
            imitation_loss=jnp.asarray(fields.inner("history").numbers("imitation", (None,))),
            task_nodes=tuple(_task_node(each) for each in fields.each("task_nodes")),
            contacts=tuple(_contact(each, names) for each in fields.each("contacts")),
        ),
        fields.inner("made").content,
    )


def _task_node(fields: JsonFields) -> TaskNode:
    trajectories = fields.count("trajectories", 0)
    active = fields.count("active_trajectories", 0)
    return TaskNode(
        name=fields.text("name"),
        actuated=fields.truth("actuated"),
        trajectories=trajectories,
        active_trajectories=active,
        first_contact_time=fields.number("first_contact_time_s") if active else None,
    )


def _contact(fields: JsonFields, kept_nodes: tuple[str, ...]) -> LearnedContact:
    kind, nodes = fields.text("kind"), fields.names("nodes")
    if kind not in KINDS:
        raise InvalidInputError(
            f"{fields.where}: field 'kind' must be {', '.join(KINDS)}, found {kind!r}"
        )
    if len(nodes) != 2 or not set(nodes) <= set(kept_nodes):
        raise InvalidInputError(
            f"{fields.where}: field 'nodes' must be two of {', '.join(kept_nodes)}, "
            f"found {', '.join(nodes)}"
        )
    varies = isinstance(fields.content.get("weight"), list)
    weight = fields.numbers("weight", (None,) if varies else ())
    if weight.min() < 0.0:
        raise InvalidInputError(
            f"{fields.where}: field 'weight' must be at least 0, found {weight.min():g}"
        )
    return LearnedContact(
        kind, (nodes[0], nodes[1]), tuple(weight.tolist()) if varies else float(weight)
    )


def _numbers(values: Any) -> Any:
    """Nested lists of numbers with the fewest digits that give the same ones back."""
    array = np.asarray(values)
    if array.ndim:
        return [_numbers(part) for part in array]
    return float(str(array[()]))


def _text(value: Any, indent: str = "\n") -> str:
    """JSON with a line for each element of an object or a list of lists; the rest is one line."""
    inner = indent + "  "
    if isinstance(value, dict) and value:
        parts = [f"{_line(str(key))}: {_text(each, inner)}" for key, each in value.items()]
        return "{" + inner + f",{inner}".join(parts) + indent + "}"
    if isinstance(value, list) and any(isinstance(each, list | dict) for each in value):
        return "[" + inner + f",{inner}".join(_text(each, inner) for each in value) + indent + "]"
    return _line(value)


def _line(value: Any) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


def _of_steps(
    fields: JsonFields, name: str, size: int | None = None, semi: bool = False
) -> np.ndarray:
    """A matrix as `_definite`, or one a step; ``size`` None: as many columns as rows."""
    value: Any = fields.content.get(name)
    first = value[0] if isinstance(value, list) and value else None
    if not (isinstance(first, list) and first and isinstance(first[0], list)):
        return _definite(fields, name, fields.rows(name) if size is None else size, semi)
    size = len(first) if size is None else size
    steps = (JsonFields(f"{fields.where}: step {t}", {name: one}) for t, one in enumerate(value))
    return np.stack([_definite(each, name, size, semi) for each in steps])


def _definite(fields: JsonFields, name: str, size: int, semi: bool = False) -> np.ndarray:
    """[size, size] symmetric, with eigenvalues above zero; ``semi``: none below, but for rounding.

    Raises `InvalidInputError` where the field is not so.
    """
    matrix = fields.numbers(name, (size, size))
    apart = np.abs(matrix - matrix.T)
    if apart.max() > ROUNDING * np.abs(matrix).max():
        row, column = np.unravel_index(np.argmax(apart), apart.shape)
        raise InvalidInputError(
            f"{fields.where}: field {name!r} must be symmetric, found {matrix[row, column]:g} in "
            f"row {row}, column {column} and {matrix[column, row]:g} the other way round"
        )
    matrix = 0.5 * (matrix + matrix.T)
    smallest, largest = np.linalg.eigvalsh(matrix)[[0, -1]]
    if smallest < -ROUNDING * max(largest, 0.0) if semi else not smallest > 0.0:
        raise InvalidInputError(
            f"{fields.where}: field {name!r} must be positive {'semi-' if semi else ''}definite, "
            f"but its smallest eigenvalue is {smallest:.3g}"
        )
    return matrix
