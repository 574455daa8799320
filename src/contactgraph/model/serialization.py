"""Arrays of modules by path."""

from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.data.errors import InvalidInputError

Tree = TypeVar("Tree")


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
