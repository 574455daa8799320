"""The schema of recorded data: axes, type, unit and rules of every array.

`Scene` and `Trajectory` declare each array once, with its `Field`. Checks, files, changes of units
and of the time step, and padding read it there.
"""

import dataclasses
import reprlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, get_args, get_origin

import numpy as np

from contactgraph.data.errors import InvalidInputError

Owner = TypeVar("Owner")

ABSENT: Any = None
"""For an array that is not given; the constructor replaces it by `Field.absent`."""

_ROWS = {"N": "for", "T": "at step", "T+1": "at step", **dict.fromkeys("EJLPQ", "in row")}
"""Axes along which values do not form a vector, and how an error names an index of them."""
_OWN_ROWS = "JPQ"
"""Axes of things that a scene has any number of."""
_LEAST = {"T": 1, "L": 2, "V": 3}
"""The least sizes of axes."""
_TOLERANCE, _LOOSE_TOLERANCE = 1e-6, 1e-3
"""Largest error of the length of a plane's normal, and of a quaternion, which leaves room for
16-bit floats."""


@dataclass(frozen=True)
class Rule:
    """A rule of the values of an array, such as that they are finite."""

    words: str
    """What the array must do; ``{last}`` is the largest index of a node."""
    holds: Callable[[np.ndarray, int], np.ndarray]
    """Of the values and the number of nodes: whether it holds, for each value or each row."""


def _row_or_none(value: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    return np.asarray(allowed.all(axis=-1) | np.isnan(value).all(axis=-1))


def _unit_length(value: np.ndarray, tolerance: float) -> np.ndarray:
    return np.asarray(np.abs(np.linalg.norm(value, axis=-1) - 1.0) <= tolerance)


def _is_node(value: np.ndarray, count: int) -> np.ndarray:
    return (value >= 0) & (value < count)


FINITE = Rule("be finite", lambda value, _: np.isfinite(value))
NOT_NEGATIVE = Rule(
    "be finite and not negative", lambda value, _: np.isfinite(value) & (value >= 0.0)
)
FINITE_OR_NONE = Rule(
    "be finite, or NaN throughout where it is not known",
    lambda value, _: _row_or_none(value, np.isfinite(value)),
)
SIDES_OR_NONE = Rule(
    "be positive, or NaN throughout for a node that is no box",
    lambda value, _: _row_or_none(value, np.isfinite(value) & (value > 0.0)),
)
BOUNDS = Rule(
    "be lower bounds below upper ones, each finite or NaN for none",
    lambda value, _: ~np.isinf(value).any(axis=1) & ~(value[:, 0] >= value[:, 1]),
)
PLANES = Rule(
    "be a normal of length 1 and a finite offset",
    lambda value, _: _unit_length(value[:, :-1], _TOLERANCE) & np.isfinite(value[:, -1]),
)
TURNS_OR_NONE = Rule(
    "be finite angles or quaternions of length 1, or NaN throughout where it is not known",
    lambda value, _: _row_or_none(
        value,
        np.isfinite(value)
        & ((value.shape[-1] == 1) | _unit_length(value, _LOOSE_TOLERANCE)[..., None]),
    ),
)
SYMMETRIC = Rule(
    "be symmetric in its two node axes",
    lambda value, _: np.all(value == value.swapaxes(1, 2), axis=(1, 2)),
)
NODES = Rule("name nodes 0 to {last}", _is_node)
PAIRS = Rule(
    "join two different nodes of 0 to {last}",
    lambda value, count: _is_node(value, count).all(axis=1) & (value[:, 0] != value[:, 1]),
)


@dataclass(frozen=True)
class Field:
    """An array, or a tuple of texts or of arrays, of a `Scene` or a `Trajectory`."""

    axes: str
    """Their sizes. ``T`` counts steps, ``T+1`` states, ``N`` nodes, ``D`` degrees of freedom a
    node, ``U`` components of the control; ``1|4`` is 1, but 4 where D = 3. Any other letter stands
    for a number of its own. With ``V`` it is a tuple of arrays, whose ``V`` differs."""
    kind: type = float
    """Of the values: float, int, bool or str."""
    unit: str | None = None
    rule: Rule = FINITE
    place: bool = False
    """Whether values are positions in the world, which depend on its origin."""
    fill: float | None = None
    """The value of nodes that do not exist (default: 0), and of an array that is not given: see
    `absent`."""

    @property
    def axis(self) -> tuple[str, ...]:
        """One text an axis."""
        return tuple(self.axes.split())

    @property
    def shape(self) -> str:
        """The axes as Python writes a shape."""
        return _times(self.axis)

    @property
    def of_length(self) -> bool:
        """Whether the values are proportional to the unit of length."""
        return self.unit in ("m", "m/s", "m/s^2")

    @property
    def is_tuple(self) -> bool:
        """Whether it is a tuple of arrays."""
        return "V" in self.axis[1:2]

    @property
    def padding(self) -> float:
        """The value of nodes that do not exist."""
        return 0.0 if self.fill is None else self.fill

    def absent(self, sizes: dict[str, int]) -> Any:
        """What stands for an array that is not given: no rows, or `fill` in all places; None where
        that would be taken for a value."""
        if self.fill is None:
            return None
        if self.is_tuple:
            return ()
        shape = [_size(axis, sizes) or 0 for axis in self.axis]
        return np.full(shape, self.fill, self.kind)

    def is_absent(self, value: Any) -> bool:
        """Whether a value equals what stands for an array that is not given, for any sizes."""
        if value is None or self.fill is None or self.is_tuple:
            return value is None or (self.is_tuple and not len(value))
        found = np.asarray(value)
        if self.axis[0] in _OWN_ROWS:
            return found.ndim > 0 and not len(found)
        if found.ndim != len(self.axis):
            return False
        return bool(np.all(found != found if np.isnan(self.fill) else found == self.fill))

    def checked(
        self, name: str, value: Any, sizes: dict[str, int], node_name: tuple[str, ...]
    ) -> Any:
        """The value in its type; raises `InvalidInputError` where shape or values are wrong.

        ``sizes`` are known by the letters of axes; those that were not are added.
        """
        if self.kind is str:
            texts = tuple(map(str, value))
            self._check_shape(name, (len(texts),), sizes)
            return texts
        if self.is_tuple:
            first, *others = self.axis
            one = dataclasses.replace(self, axes=" ".join(others))
            sizes.setdefault(first, len(value))
            return tuple(
                one.checked(f"{name}[{index}]", each, dict(sizes), node_name)
                for index, each in enumerate(value)
            )
        given = np.asarray(value)
        if self.kind is int and not np.all(np.isfinite(given) & (given == np.rint(given))):
            raise InvalidInputError(f"{name} must be integers, found {given.dtype}")
        found: np.ndarray = given.astype(self.kind, copy=False)
        self._check_shape(name, found.shape, sizes)
        self._check_values(name, found, node_name)
        return found

    def _check_shape(self, name: str, shape: tuple[int, ...], sizes: dict[str, int]) -> None:
        wanted = [_size(axis, sizes) for axis in self.axis]
        least = {letter: size for letter, size in _LEAST.items() if letter not in sizes}
        fits = len(shape) == len(wanted)
        for axis, size, found in zip(self.axis, wanted, shape, strict=False):
            sizes.setdefault(axis[0], found - axis.endswith("+1"))
            fits &= size in (None, found) and sizes[axis[0]] >= least.get(axis[0], 0)
        if not fits:
            numbers = _times(
                axis if size is None else size for axis, size in zip(self.axis, wanted, strict=True)
            )
            equal = "" if numbers == self.shape else f" = {numbers}"
            limits = "".join(
                f" with {each} >= {least[each]}" for each in least if each in self.axes
            )
            raise InvalidInputError(
                f"{name} must have shape {self.shape}{equal}{limits}, found {shape}"
            )

    def _check_values(self, name: str, value: np.ndarray, node_name: tuple[str, ...]) -> None:
        rows = sum(axis in _ROWS for axis in self.axis)
        holds = self.rule.holds(value, len(node_name))
        holds = np.all(holds, axis=tuple(range(rows, holds.ndim)))
        if not holds.all():
            index = tuple(np.argwhere(~holds)[0].tolist())
            where = [
                f" {_ROWS[axis]} {repr(node_name[at]) if axis == 'N' else at}"
                for axis, at in sorted(zip(self.axis, index, strict=False))
            ]
            words = self.rule.words.format(last=len(node_name) - 1)
            found = reprlib.repr(value[index].tolist())
            raise InvalidInputError(f"{name} must {words}, found {found}{''.join(where)}")


def _size(axis: str, sizes: dict[str, int]) -> int | None:
    """The size of an axis; None where it is not known."""
    if axis.isdigit():
        return int(axis)
    if "|" in axis:
        return int(axis.split("|")[sizes["D"] == 3])
    size = sizes.get(axis[0])
    return None if size is None else size + axis.endswith("+1")


def _times(axes: Iterable[object]) -> str:
    texts = [str(each) for each in axes]
    return f"({', '.join(texts)}{',' * (len(texts) == 1)})"


def fields_of(owner: Any) -> dict[str, Field]:
    """The fields that a dataclass declares as ``Annotated[..., Field(...)]``, by their names."""
    types = {each.name: each.type for each in dataclasses.fields(owner)}
    return {
        name: get_args(each)[1] for name, each in types.items() if get_origin(each) is Annotated
    }


def given_fields(owner: Any) -> dict[str, Field]:
    """The fields whose arrays are given, by their names."""
    fields = fields_of(owner)
    return {name: each for name, each in fields.items() if not each.is_absent(getattr(owner, name))}


def check_fields(owner: Any, sizes: dict[str, int], node_name: tuple[str, ...]) -> None:
    """Gives all arrays of a `Scene` or `Trajectory` their types, see `Field.checked`, and makes
    those that are not given."""
    for name, field in fields_of(owner).items():
        value = getattr(owner, name)
        if field.is_absent(value):
            value = field.absent(sizes)
        else:
            value = field.checked(name, value, sizes, node_name)
        object.__setattr__(owner, name, value)


def changed(
    owner: Owner, change: Callable[[Field, np.ndarray], np.ndarray], **others: Any
) -> Owner:
    """A `Scene` or `Trajectory` with ``change(field, array)`` in place of every array.

    ``others`` are fields to replace by something else.
    """
    arrays: dict[str, Any] = {}
    for name, field in fields_of(owner).items():
        value = getattr(owner, name)
        if value is not None and field.kind is not str:
            is_tuple = field.is_tuple
            arrays[name] = (
                tuple(change(field, each) for each in value) if is_tuple else change(field, value)
            )
    found: Any = owner
    replaced: Owner = dataclasses.replace(found, **{**arrays, **others})
    return replaced
