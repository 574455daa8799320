"""Traced programs kept on disk, so that a new process does not trace them again.

JAX keeps compiled programs (``jax_compilation_cache_dir``), but finds them by the traced program,
and tracing takes longer than reading them. A program is kept beside them as `jax.export` writes it,
under a hash of all that it is made of: the package's source, the versions of the libraries, JAX's
settings, and the structure, shapes and static parts of its arguments. Nothing in a file is executed
as Python, a file that is damaged is written again, and only the programs of the last few states of
the source remain.
"""

import dataclasses
import hashlib
import logging
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from enum import Enum
from functools import cache
from inspect import unwrap
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jaxlib
import numpy as np
from jax import export
from jax.extend.core import Primitive
from jax.interpreters import mlir

from contactgraph.data import InvalidInputError, atomic_write

_KNOWN = ("builtins", "collections", "contactgraph", "equinox", "jax", "numpy")
"""Packages whose classes and functions a name determines, given the versions and the source."""
_IMMATERIAL = ("cache", "debug_log", "dump", "log_compiles", "logging", "traceback")
"""Parts of the names of settings that do not change a program."""
_RELEASES = ("0.10.", "0.11.", "0.12.")
"""Of JAX, whose internal modules this one is known to fit; with others nothing is kept."""
_DIGEST = 32
_STATES = 4
"""States of the source whose programs remain."""
_STARTED = time.time() - 1.0
"""s; source files that are newer may be other than the modules in use."""
_bindings: list[tuple[Any, dict[str, Any]]] = []
_log = logging.getLogger(__name__)


class _Unnamed(Exception):
    """An object has no name that another process would give it, too."""


def stored(call: Callable, static: Any, like: int | None = None) -> Callable:
    """A function of arrays to be traced by `jax.jit`, which reads its program from disk if it can.

    ``static``: all that ``call`` depends on beside its arguments. The result has the structure of
    the argument at index ``like``; None: that of an earlier result, so the first is always traced.

    Nothing is kept where JAX keeps no programs, nor a program with classes or functions of other
    packages, nor any in a process in which names of this package were rebound.
    """
    structures: dict[Any, Any] = {}

    def traced(*inputs: Any) -> Any:
        leaves, structure = jax.tree.flatten(inputs)
        made = structures.get(structure) if like is None else jax.tree.structure(inputs[like])
        traceable = made is not None and all(isinstance(leaf, jax.core.Tracer) for leaf in leaves)
        path = _path((static, made), inputs) if traceable else None
        program = None if path is None else _read(path, leaves) or _export(path, call, inputs, made)
        if program is not None:
            used = (leaves[index] for index in program.module_kept_var_idx)
            return jax.tree.unflatten(made, _program.bind(*used, program=program))
        result = call(*inputs)
        structures[structure] = jax.tree.structure(result)
        return result

    return traced


def note_bindings(*packages: str) -> None:
    """Remember what the names of the packages' modules and classes are bound to.

    A program on disk is that of the source: it is not used once a name is bound to something else.
    What was bound anew before this call is not noticed.
    """
    for name, module in list(sys.modules.items()):
        if f"{name}.".startswith(tuple(f"{package}." for package in packages)):
            own = [each for each in vars(module).values() if isinstance(each, type)]
            classes = [each for each in own if each.__module__ == name]
            _bindings.extend((each, dict(vars(each))) for each in (module, *classes))


def _rebound() -> bool:
    for owner, bound in _bindings:
        now = vars(owner)
        if any(now.get(name) is not value for name, value in bound.items()):
            return True
    return not _bindings


def _folder() -> Path | None:
    """Of this source's programs, below those that JAX compiled; None where it keeps none."""
    settings: Any = jax.config
    folder = settings.jax_compilation_cache_dir if settings.jax_enable_compilation_cache else None
    if not jax.__version__.startswith(_RELEASES):
        return None
    if folder is None or "://" in folder or (source := _source()) is None:
        return None
    return Path(folder) / "traced" / source


def _path(static: Any, arrays: Any) -> Path | None:
    """The file of a program, by its static parts and the arrays' shapes; None: none is kept."""
    folder = _folder()
    if folder is None or _rebound():
        return None
    try:
        parts = [*_described(jax.tree.structure((static, arrays)))]
        parts += map(_named, jax.tree.leaves(static))
        parts += [
            f"{jax.typeof(leaf)} {jax.typeof(leaf).weak_type}"
            if isinstance(leaf, jax.Array)
            else _named(leaf)
            for leaf in jax.tree.leaves(arrays)
        ]
    except _Unnamed as reason:
        _log.debug("a program is not kept: %s has no name", reason)
        return None
    parts += [*_settings(), jax.default_backend(), jax.__version__, jaxlib.__version__]
    parts += [eqx.__version__, np.__version__, sys.version]
    return folder / hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _settings() -> Iterator[str]:
    settings: Any = jax.config
    for name in sorted(settings.values):
        if not any(part in name for part in _IMMATERIAL):
            yield f"{name}={getattr(settings, name, None)}"


def _read(path: Path, leaves: list[Any]) -> export.Exported | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    written = content[_DIGEST:]
    try:
        if hashlib.sha256(written).digest() != content[:_DIGEST]:
            raise ValueError("checksum does not fit the content")
        program = export.deserialize(bytearray(written))
        if [(each.shape, each.dtype) for each in program.in_avals] != [
            (leaf.shape, leaf.dtype) for leaf in leaves
        ]:
            raise ValueError("the program is about other arrays")
    except Exception as fault:  # The reader raises errors of many types.
        _log.warning("%s is not read (%s); it is written again", path, fault)
        return None
    return program


def _export(path: Path, call: Callable, inputs: Any, made: Any) -> export.Exported | None:
    """The program, which is written; None where it cannot be kept."""
    leaves, structure = jax.tree.flatten(inputs)
    found = []

    def flat(*arrays: Any) -> list[Any]:
        result, returned = jax.tree.flatten(call(*jax.tree.unflatten(structure, arrays)))
        found.append(returned)
        return result

    shapes = [
        jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, weak_type=leaf.aval.weak_type)
        for leaf in leaves
    ]
    try:
        program = export.export(jax.jit(flat))(*shapes)
        # Targets of custom calls are registered by tracing alone; effects would be lost.
        simple = b"custom_call" not in program.mlir_module_serialized
        if not simple or program.ordered_effects or program.unordered_effects or found != [made]:
            return None
        written = bytes(program.serialize())
    except (ImportError, ValueError, NotImplementedError) as fault:
        _log.debug("a program is not kept: %s", fault)
        return None
    _write(path, hashlib.sha256(written).digest() + written)
    return program


def _write(path: Path, content: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        states = sorted(path.parents[1].iterdir(), key=lambda each: each.stat().st_mtime)
        for old in states[:-_STATES]:
            shutil.rmtree(old, ignore_errors=True)
        with atomic_write(path) as temporary:
            temporary.write_bytes(content)
    except (OSError, InvalidInputError) as fault:
        _log.debug("a program is not kept: %s", fault)


# `Exported.call` commits its results to a device, with which the next call would compile again, and
# imports SciPy. A primitive whose lowering is the program's text does neither.
_program = Primitive("stored_program")
_program.multiple_results = True


@_program.def_abstract_eval
def _avals(*_: Any, program: export.Exported) -> tuple[Any, ...]:
    return tuple(program.out_avals)


def _lowering(context: Any, *inputs: Any, program: export.Exported) -> Any:
    from jax.extend.mlir import ir
    from jax.extend.mlir.dialects import func

    whole = context.module_context
    with whole.module.context:
        part = program.mlir_module(serialized=False)
    name = mlir.merge_mlir_modules(whole.module, "stored", part, dst_symtab=whole.symbol_table)
    types = [mlir.aval_to_ir_type(whole, each) for each in context.avals_out]
    return func.CallOp(types, ir.FlatSymbolRefAttr.get(name), inputs).results


mlir.register_lowering(_program, _lowering)


def _described(structure: Any) -> Iterator[str]:
    """A tree's classes and their static parts, in order."""
    data, children = structure.node_data(), structure.children()
    yield "leaf" if data is None else f"{_named(data[0])} {_named(data[1])} {len(children)}"
    for child in children:
        yield from _described(child)


def _named(value: Any) -> str:
    """A static part by its value, or by where its module binds it."""
    match value:
        case None | bool() | int() | float() | str() | bytes():
            return repr(value)
        case tuple() | list():
            return f"{_named(type(value))}({', '.join(map(_named, value))})"
        case np.ndarray() if value.dtype != object:
            content = np.ascontiguousarray(value).tobytes()
            return f"{value.dtype}{value.shape} {hashlib.sha256(content).hexdigest()}"
        case jax.tree_util.PyTreeDef():
            return " ".join(_described(value))
        case Enum():
            return f"{_named(type(value))}.{value.name}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = (_named(getattr(value, each.name)) for each in dataclasses.fields(value))
        return f"{_named(type(value))}({', '.join(parts)})"
    if value is type(None):
        return "NoneType"
    if type(value).__name__ == "_Missing":  # Equinox's mark of a field without a value
        return f"{_named(type(value))}()"
    # A function that wraps another one has its names, but is not what they are bound to.
    inner = unwrap(value) if callable(value) else value
    module = sys.modules.get(str(getattr(inner, "__module__", None)))
    if module is None or module.__name__.split(".")[0] not in _KNOWN:
        raise _Unnamed(repr(value))
    name = getattr(inner, "__qualname__", "")
    if "<lambda>" in name:
        name = next((bound for bound, each in vars(module).items() if each is value), "")
    found: Any = module
    for part in name.split("."):
        found = getattr(found, part, None)
    if found is not value:
        raise _Unnamed(repr(value))
    return f"{module.__name__}.{name}"


@cache
def _source() -> str | None:
    """A hash of the package's source; None where a file has changed since this process began."""
    folder = Path(__file__).parents[1]
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        if path.stat().st_mtime > _STARTED:
            return None
        found.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return found.hexdigest()
