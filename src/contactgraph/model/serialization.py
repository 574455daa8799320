"""Models as plain data: weights by path, and constructor arguments by name.

``{"type": "SmoothCutoff", "arguments": {"inner": 0.15, "outer": 0.25}}`` stands for
``SmoothCutoff(inner=0.15, outer=0.25)``. Names from a file are only looked up in the tables below,
and values are checked against the constructors' annotations before anything is called.
"""

import dataclasses
import inspect
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.model.actuation import Actuation
from contactgraph.model.body_head import BodyHead
from contactgraph.model.collision import ClosestApproachPrior, DistancePrior, NoCutoff, SmoothCutoff
from contactgraph.model.contact_belief import ArgmaxSample, ContactSensor, GumbelSample
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.edge_inference import EdgeInference
from contactgraph.model.features import AbsoluteFeatures, InvariantFeatures
from contactgraph.model.force_laws import ExpectedTypes, RelationDynamics
from contactgraph.model.heads import CoupledHead, GroundSupport, PerDegreeHead
from contactgraph.model.local_dynamics import (
    FreeLinearDynamics,
    SpringMassDamperDynamics,
    ThetaMethod,
)
from contactgraph.model.message_passing import EdgeNetwork, MessagePassing, TypedMessagePassing
from contactgraph.model.motion_noise import PredictionNoise
from contactgraph.model.relation_model import RelationModel
from contactgraph.model.relations import StaticEdges

Tree = TypeVar("Tree")
Description = dict[str, Any]


def module_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Every array of a tree (modules, optimiser states, lists, …) by its path, dtypes kept.

    A path reads like ``inference.message_passing.steps.0.edge.weight``. Other leaves are left out.
    Raises `InvalidInputError` where a leaf is a typed random key or two paths read the same.
    """
    arrays: dict[str, np.ndarray] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if not _is_array(leaf):
            continue
        name = _name(path)
        if name in arrays:
            raise InvalidInputError(f"array {name!r}: two paths of the tree have this name")
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            raise InvalidInputError(
                f"array {name!r} is a typed random key, must be plain numbers (jax.random.key_data)"
            )
        arrays[name] = np.asarray(leaf, order="C")
    return arrays


def with_arrays(tree: Tree, arrays: Mapping[str, np.ndarray], where: str) -> Tree:
    """The tree with its arrays replaced by those of `module_arrays`.

    The tree's own arrays, or `jax.ShapeDtypeStruct`, determine shapes and dtypes. Raises
    `InvalidInputError`, starting with `where`, for an array that is missing, unknown or unfit.
    """
    left = dict(arrays)

    def replace(path: tuple[Any, ...], leaf: Any) -> Any:
        if not (_is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)):
            return leaf
        name = _name(path)
        if name not in left:
            raise InvalidInputError(f"{where}: array {name!r} is missing")
        array = left.pop(name)
        if array.shape != leaf.shape or array.dtype != leaf.dtype:
            raise InvalidInputError(
                f"{where}: array {name!r} must be {leaf.dtype} of shape {leaf.shape}, "
                f"found {array.dtype} of shape {array.shape}"
            )
        return jax.device_put(array)  # `jnp.asarray` would compile a program for every shape.

    filled = jax.tree_util.tree_map_with_path(replace, tree)
    if left:
        raise InvalidInputError(f"{where}: array {min(left)!r} is not part of it")
    return filled


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


def _name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


_MODELS = ContactDynamics, RelationModel
_CLASSES: dict[str, type[eqx.Module]] = {
    known.__name__: known
    for known in (
        AbsoluteFeatures,
        Actuation,
        ArgmaxSample,
        BodyHead,
        ClosestApproachPrior,
        ContactSensor,
        CoupledHead,
        DistancePrior,
        EdgeNetwork,
        ExpectedTypes,
        FreeLinearDynamics,
        GroundSupport,
        GumbelSample,
        InvariantFeatures,
        MessagePassing,
        NoCutoff,
        PerDegreeHead,
        PredictionNoise,
        RelationDynamics,
        SmoothCutoff,
        SpringMassDamperDynamics,
        StaticEdges,
        ThetaMethod,
        TypedMessagePassing,
        *typing.get_args(EdgeInference),
        *_MODELS,
    )
}
_MAX_SIZE = 1024
"""Of any width, count or dimension; bounds the memory that a damaged file can ask for."""


def describe(model: ContactDynamics) -> Description:
    """The model's construction, without weights, as data that JSON can represent.

    Its neighbor list is left out, because it is made for a scene and changes no prediction. Raises
    `InvalidInputError` for parts that are not of this package.
    """
    if isinstance(model, ContactDynamics):
        model = dataclasses.replace(model, neighbor_list=None)
    return _describe(model, _MODELS, "model")


def build(description: object, where: str) -> ContactDynamics:
    """A model of this construction whose weights are shapes alone (`jax.ShapeDtypeStruct`).

    Raises `InvalidInputError`, starting with `where`, for anything that no model has.
    """
    try:
        return eqx.filter_eval_shape(lambda: _build(description, _MODELS, where))
    except RecursionError as error:
        raise InvalidInputError(f"{where}: must not be nested this deeply") from error


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
    if isinstance(value, tuple):  # names
        return list(value)
    if typing.get_origin(kinds[0]) is list:
        each = _part_types(kinds[0])
        return [_describe(part, each, f"{where}.{i}") for i, part in enumerate(value)]
    return _describe(value, kinds, where)


def _build(value: object, allowed: tuple[type, ...], where: str) -> Any:
    if not isinstance(value, dict) or set(value) != {"type", "arguments"}:
        raise InvalidInputError(f"{where}: must be an object of 'type' and 'arguments'")
    name, given = value["type"], value["arguments"]
    if not isinstance(name, str) or _CLASSES.get(name) not in allowed:
        raise InvalidInputError(f"{where}.type: must be {_names(allowed)}, found {_short(name)}")
    expected = _arguments(_CLASSES[name])
    if not isinstance(given, dict) or not _needed(_CLASSES[name]) <= set(given) <= set(expected):
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
        if type(value) is not int or not 0 <= value <= _MAX_SIZE:
            raise InvalidInputError(
                f"{where}: must be an integer from 0 to {_MAX_SIZE}, found {_short(value)}"
            )
        return value
    if kind is float:
        if type(value) not in (int, float) or not math.isfinite(value):
            raise InvalidInputError(f"{where}: must be a finite number, found {_short(value)}")
        return float(value)
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list) or not all(isinstance(part, str) for part in value):
            raise InvalidInputError(f"{where}: must be a list of names")
        return tuple(value)
    if typing.get_origin(kind) is list:
        if not isinstance(value, list) or not 1 <= len(value) <= _MAX_SIZE:
            raise InvalidInputError(f"{where}: must be a list of 1 to {_MAX_SIZE} parts")
        return [_build(part, _part_types(kind), f"{where}.{i}") for i, part in enumerate(value)]
    return _build(value, kinds, where)


def _arguments(known: Any) -> dict[str, tuple[Any, ...]]:
    """The constructor's arguments, and the types allowed for each."""
    return {
        name: _allowed(parameter.annotation)
        for name, parameter in inspect.signature(known.__init__).parameters.items()
        if name not in ("self", "key")
    }


def _allowed(annotation: Any) -> tuple[Any, ...]:
    union = isinstance(annotation, types.UnionType)
    return typing.get_args(annotation) if union else (annotation,)


def _needed(known: Any) -> set[str]:
    """The arguments that are not None by default: `describe` leaves out those that are None."""
    given = inspect.signature(known.__init__).parameters
    return {name for name in _arguments(known) if given[name].default is not None}


def _part_types(kind: Any) -> tuple[Any, ...]:
    """The types allowed for the parts of a list."""
    return _allowed(*typing.get_args(kind))


def _names(allowed: tuple[type, ...]) -> str:
    return " or ".join(known.__name__ for known in allowed)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
