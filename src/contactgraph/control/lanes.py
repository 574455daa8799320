"""`jax.vmap` along the last axis: many small problems side by side in a core's vector lanes.

XLA's loops run along the last axis. With a batch in front, loops over arrays of two or three
numbers have two or three rounds; with the batch behind, they fill vectors.
"""

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import Array

_Made = TypeVar("_Made")

_ELEMENTWISE = """abs add add_any and ceil clamp convert_element_type copy div eq exp expm1 floor ge
gt integer_pow is_finite le log log1p logistic lt max min mul ne neg not or pow rsqrt select_n sign
sqrt square stop_gradient sub tanh"""
_ALONG_AXES = """argmax argmin cumsum reduce_and reduce_max reduce_min reduce_or rev split squeeze
unstack"""
"""Operations that name the axes on which they act, and treat all others alike."""
_CALLS = "jit pjit closed_call custom_jvp_call custom_vjp_call"
_WRITTEN_OUT, _FEW_TERMS = 16, 7
"""Most terms of a sum that is written out as additions, and of a matrix product that is."""


class _Lanes:
    """A value [..., lanes] of each lane; one without this is the same in all lanes."""

    def __init__(self, value: Array, factors: Sequence[Array] | None = None) -> None:
        self.value, self.factors = value, factors or (value,)
        """Factors, so that a sum of products need not write the products to memory."""


jax.tree_util.register_pytree_node(
    _Lanes, lambda each: ((each.value,), None), lambda _, children: _Lanes(*children)
)


def in_lanes(function: Callable[..., _Made], lanes: int) -> Callable[..., _Made]:
    """``jax.vmap(function, in_axes=-1, out_axes=-1)`` of ``lanes`` calls, to rounding.

    It reads the function's operations one by one. Those that it does not know go through
    `jax.vmap`, with the batch in front. It is not made for gradients.
    """

    def mapped(*arguments: Any) -> Any:
        leaves, tree = jax.tree.flatten(arguments)
        one = [jax.ShapeDtypeStruct(leaf.shape[:-1], leaf.dtype) for leaf in leaves]
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*jax.tree.unflatten(tree, one))
        made = _evaluate(closed, [_Lanes(leaf) for leaf in leaves], lanes)
        made = [_spread(each, lanes) for each in made]
        return jax.tree.unflatten(jax.tree.structure(shape), made)

    return mapped


def _evaluate(closed: ClosedJaxpr, inputs: Sequence[Any], lanes: int) -> list[Any]:
    known: dict[Any, Any] = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    known.update(zip(closed.jaxpr.invars, inputs, strict=True))

    def read(atom: Any) -> Any:
        dtype = atom.aval.dtype
        return np.asarray(atom.val, dtype) if isinstance(atom, Literal) else known[atom]

    for equation in closed.jaxpr.eqns:
        made = _apply(equation, [read(atom) for atom in equation.invars], lanes)
        known.update(zip(equation.outvars, made, strict=True))
    return [read(atom) for atom in closed.jaxpr.outvars]


def _apply(equation: Any, values: list[Any], lanes: int) -> list[Any]:
    """The results of one operation."""
    name, params = equation.primitive.name, equation.params
    if name in _CALLS.split():
        return _evaluate(params["jaxpr" if "jaxpr" in params else "call_jaxpr"], values, lanes)
    if not any(isinstance(each, _Lanes) for each in values):
        return _bind(equation, values, params)
    if name in ("scan", "while"):
        return (_scan if name == "scan" else _while)(params, values, lanes)
    shapes = [atom.aval.shape for atom in equation.invars]
    result = equation.outvars[0].aval.shape if equation.outvars else ()  # nothing is unstacked
    others = any(isinstance(each, _Lanes) for each in values[1:])
    written_out, operands = None, values
    changed: dict[str, Any] | None = None
    if name in _ELEMENTWISE.split():
        operands, changed = [_operand(each, result, lanes) for each in values], {}
    elif name in _ALONG_AXES.split():
        changed = {}
    elif name in ("concatenate", "stack"):
        operands, changed = [_spread(each, lanes) for each in values], {}
    elif name == "reduce_sum":
        written_out = _sum(values[0].factors, params["axes"])
    elif name == "dot_general":
        written_out = _product(params, shapes, values)
    elif name == "dynamic_slice" and others:
        written_out = _own_slices(values, shapes[0], params["slice_sizes"], lanes)
    elif name.startswith("scatter") and not isinstance(values[1], _Lanes):
        operands = [_spread(values[0], lanes), values[1], _spread(values[2], lanes)]
        numbers = params["dimension_numbers"]
        windows = (*numbers.update_window_dims, len(shapes[2]))
        changed = {"dimension_numbers": numbers._replace(update_window_dims=windows)}
    elif not others:
        changed = _of_array(name, params, len(result), lanes)
        if name == "dynamic_slice":
            operands = [*values, np.zeros((), equation.invars[1].aval.dtype)]
    if written_out is not None:
        return [_Lanes(written_out)]
    arrays = [each.value if isinstance(each, _Lanes) else each for each in operands]
    if changed is not None:
        factors = arrays if name == "mul" else None
        return [_Lanes(each, factors) for each in _bind(equation, arrays, {**params, **changed})]
    axes = [-1 if isinstance(each, _Lanes) else None for each in operands]
    each_lane = jax.vmap(lambda *each: _bind(equation, each, params), in_axes=axes, out_axes=-1)
    return [_Lanes(each) for each in each_lane(*arrays)]


def _bind(equation: Any, operands: Sequence[Any], params: dict[str, Any]) -> list[Any]:
    made = equation.primitive.bind(*map(jnp.asarray, operands), **params)
    return list(made) if equation.primitive.multiple_results else [made]


def _of_array(name: str, params: dict[str, Any], rank: int, lanes: int) -> dict[str, Any] | None:
    """What parameters become where the first operand alone has lanes; None: not known.

    ``rank``: the result's without lanes.
    """
    if name == "broadcast_in_dim":
        axes = (*params["broadcast_dimensions"], rank)
        return {"shape": (*params["shape"], lanes), "broadcast_dimensions": axes}
    if name == "reshape" and params["dimensions"] is None:
        return {"new_sizes": (*params["new_sizes"], lanes)}
    if name == "transpose":
        return {"permutation": (*params["permutation"], rank)}
    if name == "slice":
        begin, end = (*params["start_indices"], 0), (*params["limit_indices"], lanes)
        strides = params["strides"] and (*params["strides"], 1)
        return {"start_indices": begin, "limit_indices": end, "strides": strides}
    if name == "pad":
        return {"padding_config": (*params["padding_config"], (0, 0, 0))}
    if name == "dynamic_slice":
        return {"slice_sizes": (*params["slice_sizes"], lanes)}
    if name == "gather":
        numbers = params["dimension_numbers"]
        numbers = numbers._replace(offset_dims=(*numbers.offset_dims, rank))
        return {"dimension_numbers": numbers, "slice_sizes": (*params["slice_sizes"], lanes)}
    return None


def _spread(value: Any, lanes: int) -> Array:
    if isinstance(value, _Lanes):
        return value.value
    axes = tuple(range(jnp.ndim(value)))
    return jax.lax.broadcast_in_dim(jnp.asarray(value), (*jnp.shape(value), lanes), axes)


def _operand(value: Any, shape: tuple[int, ...], lanes: int) -> Array:
    """[*shape, lanes] of a value of this shape, or of a number."""
    array = _spread(value, lanes)
    if array.ndim == len(shape) + 1:
        return array
    return jax.lax.broadcast_in_dim(array, (*shape, lanes), (len(shape),))


def _sum(factors: Sequence[Array], axes: Sequence[int]) -> Array:
    """Of products, along short axes written out."""
    product = functools.partial(functools.reduce, operator.mul)
    for axis in sorted(axes, reverse=True):
        count = max(each.shape[axis] for each in factors)
        if 0 < count <= _WRITTEN_OUT:
            row = functools.partial(jax.lax.index_in_dim, axis=axis, keepdims=False)
            rows = [[row(each, i % each.shape[axis]) for each in factors] for i in range(count)]
            factors = [functools.reduce(operator.add, map(product, rows))]
        else:
            factors = [_sum_in_loop(factors, axis, count)]
    return product(factors)


def _sum_in_loop(factors: Sequence[Array], axis: int, count: int) -> Array:
    """Of the products along an axis, none of which is written to memory."""

    def add(index: Array, total: Array) -> Array:
        rows = [
            jax.lax.dynamic_index_in_dim(each, index % each.shape[axis], axis, keepdims=False)
            for each in factors
        ]
        return total + functools.reduce(operator.mul, rows)

    shape = jnp.broadcast_shapes(*(each.shape for each in factors))
    return jax.lax.fori_loop(0, count, add, jnp.zeros(np.delete(shape, axis), factors[0].dtype))


def _product(params: dict[str, Any], shapes: list[tuple[int, ...]], values: list[Any]) -> Any:
    """A sum of products; None where a matrix that all lanes share makes it one matrix product."""
    contracted, batch = params["dimension_numbers"]
    shared = [not isinstance(each, _Lanes) for each in values]
    terms = math.prod(shapes[0][axis] for axis in contracted[0])
    if any(shared) and not batch[0] and terms > _FEW_TERMS:
        return None
    free = [
        [axis for axis in range(len(shape)) if axis not in (*contracted[end], *batch[end])]
        for end, shape in enumerate(shapes)
    ]
    sides = []
    for end, value in enumerate(values):
        array = jnp.asarray(value)[..., None] if shared[end] else value.value
        order = (*batch[end], *free[end], *contracted[end], array.ndim - 1)
        begin = len(batch[end]) + (len(free[0]) if end == 0 else 0)  # of the other's free axes
        others = tuple(range(begin, begin + len(free[1 - end])))
        sides.append(jnp.expand_dims(array.transpose(order), others))
    first = len(batch[0]) + len(free[0]) + len(free[1])
    return _sum(sides, range(first, first + len(contracted[0])))


def _own_slices(
    values: Sequence[Any], shape: tuple[int, ...], sizes: tuple[int, ...], lanes: int
) -> Array | None:
    """The row of each lane, selected from the few that there are; None: slices are no rows."""
    array = _spread(values[0], lanes)
    for axis, (begin, count, size) in enumerate(zip(values[1:], shape, sizes, strict=True)):
        if size == count:
            continue
        if size != 1:
            return None
        rows = [jax.lax.index_in_dim(array, i, axis) for i in range(count)]
        array, first = rows[-1], _spread(begin, lanes)
        for i, row in reversed(list(enumerate(rows[:-1]))):
            array = jnp.where(first <= i, row, array)
    return array


def _scan(params: dict[str, Any], values: list[Any], lanes: int) -> list[Any]:
    if "ft_in" in params:  # from JAX 0.11 on
        constants, carried = (len(part) for part in params["ft_in"].unpack()[:2])
    else:
        constants, carried = params["num_consts"], params["num_carry"]
    fixed, start = values[:constants], values[constants : constants + carried]
    along = values[constants + carried :]

    def step(carry: list[Any], slices: list[Any]) -> tuple[list[Any], list[Any]]:
        made = _evaluate(params["jaxpr"], [*fixed, *carry, *slices], lanes)
        return _like(made[:carried], carry, lanes), made[carried:]

    def first(carry: list[Any]) -> list[Any]:
        return step(carry, jax.tree.map(lambda each: each[0], along))[0]

    kinds = {key: params[key] for key in ("length", "reverse", "unroll")}
    last, made = jax.lax.scan(step, _differing(first, start, lanes), along, **kinds)
    return [*last, *made]


def _while(params: dict[str, Any], values: list[Any], lanes: int) -> list[Any]:
    """Until no lane goes on; those that do not go on stay as they are."""
    ends = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    of_condition, of_body, start = values[: ends[0]], values[ends[0] : ends[1]], values[ends[1] :]

    def goes_on(carry: list[Any]) -> Any:
        return _evaluate(params["cond_jaxpr"], [*of_condition, *carry], lanes)[0]

    def step(carry: list[Any]) -> list[Any]:
        going = goes_on(carry)
        made = _evaluate(params["body_jaxpr"], [*of_body, *carry], lanes)
        if not isinstance(going, _Lanes):
            return _like(made, carry, lanes)
        after, before = ([_spread(each, lanes) for each in every] for every in (made, carry))
        pairs = zip(after, before, strict=True)
        return [_Lanes(jnp.where(going.value, new, old)) for new, old in pairs]

    def any_goes_on(carry: list[Any]) -> Array:
        going = goes_on(carry)
        return jnp.any(going.value) if isinstance(going, _Lanes) else going

    return jax.lax.while_loop(any_goes_on, step, _differing(step, start, lanes))


def _differing(
    step: Callable[[list[Any]], list[Any]], start: Sequence[Any], lanes: int
) -> list[Any]:
    """The values that a loop carries first, with lanes where they come to differ."""
    carry = list(start)
    while True:
        grown = _like(carry, jax.eval_shape(step, carry), lanes)
        spread: Any = jax.tree.structure(grown)
        if spread == jax.tree.structure(carry):
            return carry
        carry = grown


def _like(values: Sequence[Any], others: Sequence[Any], lanes: int) -> list[Any]:
    """The values, with lanes also where the others have them."""
    pairs = zip(values, others, strict=True)
    return [
        _Lanes(_spread(each, lanes)) if isinstance(other, _Lanes) else each for each, other in pairs
    ]
