"""A model's construction as plain data, and back: constructor arguments, nested.

``{"type": "Reach", "arguments": {"near": 0.15, "far": 0.25}}`` stands for ``Reach(near=0.15,
far=0.25)``. Names from outside are only ever looked up in the table below, and values are checked
against the constructors' annotations before anything is called.
"""

import dataclasses
import inspect
import math
import types
import typing
from typing import Any

import equinox as eqx
import jax

from contactgraph.data.errors import InvalidInputError
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.coupled_head import CoupledHead
from contactgraph.model.features import AbsoluteFeatures, InvariantFeatures
from contactgraph.model.inference import AllEdges, MemorylessEdges, RecurrentEdges
from contactgraph.model.local_dynamics import FreeLinearDynamics, SpringMassDamperDynamics
from contactgraph.model.message_passing import EdgeNetwork, MessagePassing, TypedMessagePassing
from contactgraph.model.per_degree_head import PerDegreeHead
from contactgraph.model.prior import DistancePrior, TouchPrior
from contactgraph.model.reach import Everywhere, Reach
from contactgraph.model.sampling import ArgmaxSample, GumbelSample
from contactgraph.model.support import Support
from contactgraph.model.theta_method import ThetaMethod

_CLASSES: dict[str, type[eqx.Module]] = {
    known.__name__: known
    for known in (
        AbsoluteFeatures,
        AllEdges,
        ArgmaxSample,
        ContactDynamics,
        CoupledHead,
        DistancePrior,
        EdgeNetwork,
        Everywhere,
        FreeLinearDynamics,
        GumbelSample,
        InvariantFeatures,
        MemorylessEdges,
        MessagePassing,
        PerDegreeHead,
        Reach,
        RecurrentEdges,
        SpringMassDamperDynamics,
        Support,
        ThetaMethod,
        TouchPrior,
        TypedMessagePassing,
    )
}
_LARGEST_SIZE = 1024
"""Of any width, count or dimension: what a damaged file cannot ask memory beyond."""

Description = dict[str, Any]


def describe(model: ContactDynamics) -> Description:
    """The model's construction as data that JSON can hold, weights left out.

    Neighbour lists are left out too: they are made for a scene, and change no prediction. Raises
    `InvalidInputError` for parts that are not of this package.
    """
    if isinstance(model, ContactDynamics):
        model = dataclasses.replace(model, neighbours=None)
    return _describe(model, (ContactDynamics,), "model")


def build(description: object, where: str) -> ContactDynamics:
    """A model of this construction whose weights are shapes alone (`jax.ShapeDtypeStruct`).

    Raises `InvalidInputError`, starting with `where`, for anything that no model has.
    """

    def construct() -> ContactDynamics:
        return _build(description, (ContactDynamics,), where)

    return eqx.filter_eval_shape(construct)


def _describe(module: object, allowed: tuple[type, ...], where: str) -> Description:
    if type(module) not in allowed:
        raise InvalidInputError(
            f"{where}: must be {_names(allowed)} to be stored, found {type(module).__name__}"
        )
    arguments = {
        name: _describe_value(getattr(module, name), kinds, f"{where}.{name}")
        for name, kinds in _arguments(type(module)).items()
        if getattr(module, name) is not None
    }
    return {"type": type(module).__name__, "arguments": arguments}


def _describe_value(value: Any, kinds: tuple[Any, ...], where: str) -> Any:
    if kinds[0] in (bool, int, float):
        return kinds[0](value)
    if typing.get_origin(kinds[0]) is list:
        return [
            _describe(part, _part_types(kinds[0]), f"{where}.{index}")
            for index, part in enumerate(value)
        ]
    return _describe(value, kinds, where)


def _build(value: object, allowed: tuple[type, ...], where: str) -> Any:
    if not isinstance(value, dict) or set(value) != {"type", "arguments"}:
        raise InvalidInputError(f"{where}: must be an object of 'type' and 'arguments'")
    name, given = value["type"], value["arguments"]
    if not isinstance(name, str) or _CLASSES.get(name) not in allowed:
        raise InvalidInputError(f"{where}.type: must be {_names(allowed)}, found {_short(name)}")
    expected = _arguments(_CLASSES[name])
    needed = _needed(_CLASSES[name])
    if not isinstance(given, dict) or not needed <= set(given) <= set(expected):
        found = sorted(given) if isinstance(given, dict) else given
        raise InvalidInputError(
            f"{where}.arguments: must be those of {name} ({', '.join(expected) or 'none'}), "
            f"found {_short(found)}"
        )
    values = {
        argument: _build_value(value, expected[argument], f"{where}.arguments.{argument}")
        for argument, value in given.items()
    }
    if "key" in inspect.signature(_CLASSES[name].__init__).parameters:
        values["key"] = jax.random.PRNGKey(0)
    try:
        return _CLASSES[name](**values)
    except (TypeError, ValueError, ArithmeticError) as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(f"{where}: cannot be built ({reason})") from error


def _build_value(value: Any, kinds: tuple[Any, ...], where: str) -> Any:
    kind = kinds[0]
    if kind is bool:
        if not isinstance(value, bool):
            raise InvalidInputError(f"{where}: must be true or false, found {_short(value)}")
        return value
    if kind is int:
        whole = isinstance(value, int) and not isinstance(value, bool)
        if not whole or not 0 <= value <= _LARGEST_SIZE:
            raise InvalidInputError(
                f"{where}: must be an integer from 0 to {_LARGEST_SIZE}, found {_short(value)}"
            )
        return value
    if kind is float:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not math.isfinite(value):
            raise InvalidInputError(f"{where}: must be a finite number, found {_short(value)}")
        return float(value)
    if typing.get_origin(kind) is list:
        if not isinstance(value, list) or not 1 <= len(value) <= _LARGEST_SIZE:
            raise InvalidInputError(f"{where}: must be a list of 1 to {_LARGEST_SIZE} parts")
        parts = _part_types(kind)
        return [_build(part, parts, f"{where}.{index}") for index, part in enumerate(value)]
    return _build(value, kinds, where)


def _arguments(known: Any) -> dict[str, tuple[Any, ...]]:
    """The constructor's arguments, and the types that each may have."""
    return {
        name: (
            typing.get_args(parameter.annotation)
            if isinstance(parameter.annotation, types.UnionType)
            else (parameter.annotation,)
        )
        for name, parameter in inspect.signature(known.__init__).parameters.items()
        if name not in ("self", "key")
    }


def _needed(known: Any) -> set[str]:
    """The arguments without a default: files of before the others came have only these."""
    parameters = inspect.signature(known.__init__).parameters
    return {
        name for name in _arguments(known) if parameters[name].default is inspect.Parameter.empty
    }


def _part_types(kind: Any) -> tuple[Any, ...]:
    """What the parts of a list may be."""
    (part,) = typing.get_args(kind)
    return typing.get_args(part) if isinstance(part, types.UnionType) else (part,)


def _names(allowed: tuple[type, ...]) -> str:
    return " or ".join(known.__name__ for known in allowed)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
