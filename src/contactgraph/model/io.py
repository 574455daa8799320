"""Model files: a preset, its configuration, and arrays (safetensors with a JSON header)."""

import hashlib
import importlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypedDict, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import safetensors
import safetensors.numpy

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.files import atomic_write, parse_json
from contactgraph.inference.contact_belief import ContactSensor
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.paper.presets import PAPER_PRESETS, full_ab
from contactgraph.model.presets import (
    Impacts,
    Inference,
    ModelConfig,
    Preset,
    ours,
)

FORMAT = "contactgraph-model"
VERSION = 3
# A single entry, because safetensors writes several in an order that changes between processes.
_ENTRY = "contactgraph"
_HEADER_LIMIT = 2_000_000
_DTYPES = ("float32", "float64")
_FIELDS: dict[str, Any] = {
    **{"preset": str, "config": dict, "sensor": dict | None},
    **{"training": dict, "checksum": str},
}
PRESETS: dict[str, Preset] = {
    "ours": ours,
    "ours-recurrent": partial(ours, inference=Inference.RECURRENT),
    "ours-memoryless": partial(ours, inference=Inference.MEMORYLESS),
    "ours-no-inference": partial(ours, inference=Inference.NONE),
    "ours-full-ab": full_ab,
    # Nothing imports this package, so that nobody reads it who does not use it.
    "relations": lambda config, *, key: importlib.import_module("contactgraph.relations").relations(
        config, key=key
    ),
    **PAPER_PRESETS,
}
"""By the names in files and commands."""

_Tree = TypeVar("_Tree")


class _Sensor(TypedDict):
    false_alarm: float
    miss: float
    reports_touch: bool
    delay: int


@dataclass(frozen=True)
class StoredModel:
    """A model and its training record."""

    model: ContactDynamics
    training: dict[str, Any] = field(default_factory=dict, repr=False)
    """Free-form JSON: command, seed, data, errors, versions, …"""


@dataclass(frozen=True)
class ModelSummary:
    """Content of a model file."""

    preset: str
    """Of `PRESETS`, or ``module:factory``."""
    config: ModelConfig
    training: dict[str, Any]
    """Free-form JSON: command, seed, data, errors, versions, …"""
    parameter_count: int
    size: int
    """Size of the file, bytes."""


def save_model(
    path: str | Path,
    model: ContactDynamics,
    preset: str,
    config: ModelConfig,
    training: Mapping[str, Any] | None = None,
) -> None:
    """Write a model to ``path``, atomically: the file is the old or the whole new one at any time.

    ``preset`` made it for ``config``: a name of `PRESETS`, or ``module:factory`` of your own.
    `training` is anything that JSON can represent. The same model gives the same bytes. Raises
    `InvalidInputError` for another model than the preset makes, weights that are not finite, a
    `training` that is not JSON, or a folder that is not writable.
    """
    path = Path(path)
    # Neighbor lists are made for a scene, and change no prediction.
    plain, sensor = replace(model, neighbor_list=None, sensor=None), model.sensor
    arrays = module_arrays(plain)
    _check_weights(arrays, str(path))
    if ":" not in preset and not _same_structure(plain, _shapes(_preset(preset, path), config)):
        raise InvalidInputError(f"{path}: preset {preset!r} makes another model for this config")
    kinds = _Sensor.__annotations__
    header = {
        "format": FORMAT,
        "format_version": VERSION,
        "preset": preset,
        "config": _config_fields(config),
        "sensor": sensor and {name: kind(getattr(sensor, name)) for name, kind in kinds.items()},
        "training": dict(training or {}),
    }
    try:
        header["checksum"] = _checksum(header, arrays)
        text = _json(header)
    except (TypeError, ValueError, RecursionError) as error:
        raise InvalidInputError(f"{path}: training must hold only JSON values ({error})") from error
    if json.loads(text)["training"] != header["training"]:
        raise InvalidInputError(f"{path}: training must hold only JSON values (and texts as keys)")
    if len(text) > _HEADER_LIMIT:
        raise InvalidInputError(
            f"{path}: training must be shorter than {_HEADER_LIMIT} characters, found {len(text)}"
        )
    content = safetensors.numpy.save(arrays, metadata={_ENTRY: text})
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def load_model(path: str | Path, preset: Preset | None = None) -> StoredModel:
    """Read a model that `save_model` has written; it predicts bit for bit as the saved one did.

    Nothing in the file is executed. `preset` rebuilds a model with parts that are not of this
    package. Raises `InvalidInputError`, naming file and field, for any fault in the file.
    """
    path = Path(path)
    with _opened(path) as (file, header):
        config = _config(header, path)
        made_by = preset or _preset(header["preset"], path)
        try:
            shapes = _shapes(made_by, config)
        except (TypeError, ValueError, ArithmeticError, LookupError) as error:
            reason = " ".join(str(error).split())
            raise InvalidInputError(f"{path}: config cannot be built ({reason})") from error
        arrays = {name: _weights(file, name, path) for name in file.keys()}  # noqa: SIM118
    _check_weights(arrays, str(path))
    if header.pop("checksum") != _checksum(header, arrays):
        raise InvalidInputError(f"{path}: checksum does not fit the content: the file is damaged")
    dtype = next(iter(arrays.values())).dtype if arrays else np.dtype("float32")
    model: ContactDynamics = with_arrays(_of_dtype(shapes, dtype), arrays, str(path))
    try:
        rates = msgspec.convert(header["sensor"], _Sensor | None)
        sensor = None if rates is None else ContactSensor(**rates)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{path}: sensor must be that of a model ({error})") from error
    return StoredModel(replace(model, sensor=sensor), header["training"])


def describe_model(path: str | Path) -> ModelSummary:
    """Content of a model file, from its header alone.

    Raises `InvalidInputError` as `load_model` does, but does not check the weights.
    """
    path = Path(path)
    with _opened(path) as (file, header):
        config = _config(header, path)
        sizes = [int(np.prod(file.get_slice(name).get_shape())) for name in file.keys()]  # noqa: SIM118
    return ModelSummary(
        preset=header["preset"],
        config=config,
        training=header["training"],
        parameter_count=sum(sizes),
        size=path.stat().st_size,
    )


def _preset(name: str, path: Path) -> Preset:
    if name not in PRESETS:
        raise InvalidInputError(f"{path}: has parts of your own; give their preset, {name}")
    return PRESETS[name]


def _shapes(preset: Preset, config: ModelConfig) -> ContactDynamics:
    """The model with shapes in place of weights."""
    return eqx.filter_eval_shape(lambda: preset(config, key=jax.random.PRNGKey(0)))


def _same_structure(one: ContactDynamics, other: ContactDynamics) -> bool:
    """Whether two models differ in their weights alone."""

    def shapes(each: Any) -> list[Any]:
        return [getattr(leaf, "shape", leaf) for leaf in jax.tree.leaves(each)]

    structures = {jax.tree.structure(each) for each in (one, other)}
    return len(structures) == 1 and shapes(one) == shapes(other)


def _config_fields(config: ModelConfig) -> dict[str, Any]:
    """As JSON; fields that have their defaults are left out."""
    impacts: dict[str, dict[str, Impacts]] = {}
    for (one, other), each in config.impacts.items():
        impacts.setdefault(one, {})[other] = each
    given = {each.name: getattr(config, each.name) for each in fields(config)}
    given["impacts"] = impacts
    plain = {each.name: each.default for each in fields(config)}
    kept = {name: each for name, each in given.items() if each not in (plain[name], {})}
    return msgspec.to_builtins(kept, enc_hook=lambda each: each.tolist())


def _config(header: dict[str, Any], path: Path) -> ModelConfig:
    given = dict(header["config"])
    names = {each.name for each in fields(ModelConfig)}
    if not set(given) <= names:
        raise InvalidInputError(f"{path}: config: {min(set(given) - names)!r} is unknown")
    try:
        impacts = msgspec.convert(given.pop("impacts", {}), dict[str, dict[str, Impacts]])
        given["impacts"] = {}
        config = msgspec.convert(
            given, ModelConfig, dec_hook=lambda kind, value: np.array(value, float)
        )
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{path}: config must be that of a model ({error})") from error
    pairs = {(one, other): each for one, row in impacts.items() for other, each in row.items()}
    return replace(config, impacts=pairs)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, dict[str, Any]]]:
    """The safetensors file and its header, whose four fields have the right types."""
    if not path.exists():
        raise InvalidInputError(f"{path}: does not exist")
    if not path.is_file():
        raise InvalidInputError(f"{path}: must be a file, found a folder or device")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            yield file, _header(path, file.metadata() or {})
    except (safetensors.SafetensorError, OSError) as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(
            f"{path}: must be a model file (safetensors), found something else or a damaged file "
            f"({reason})"
        ) from error


def _header(path: Path, metadata: dict[str, str]) -> dict[str, Any]:
    text = metadata.get(_ENTRY)
    if text is None:
        raise InvalidInputError(
            f"{path}: header has no entry {_ENTRY!r}: this safetensors file holds something else"
        )
    if len(text) > _HEADER_LIMIT:
        raise InvalidInputError(f"{path}: header must be shorter than {_HEADER_LIMIT} characters")
    try:
        header = parse_json(text)
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"{path}: header must be JSON ({error})") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InvalidInputError(f"{path}: header field 'format' must be {FORMAT!r}")
    version = header.get("format_version")
    if version != VERSION:
        raise InvalidInputError(
            f"{path}: header field 'format_version' must be {VERSION}, found {version!r}"
        )
    for name, kind in _FIELDS.items():
        if not isinstance(header.get(name, ...), kind):
            raise InvalidInputError(f"{path}: header field {name!r} is missing or of another type")
    return header


def _weights(file: Any, name: str, path: Path) -> np.ndarray:
    found = file.get_slice(name).get_dtype()
    if found not in ("F32", "F64"):
        raise InvalidInputError(f"{path}: array {name!r} must be F32 or F64, found {found}")
    return file.get_tensor(name)


def _json(value: object) -> str:
    return json.dumps(value, sort_keys=True, allow_nan=False)


def _checksum(header: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256(_json(header).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _check_weights(arrays: Mapping[str, np.ndarray], where: str) -> None:
    for name, array in arrays.items():
        if array.dtype not in _DTYPES:
            raise InvalidInputError(
                f"{where}: array {name!r} must be {' or '.join(_DTYPES)}, found {array.dtype}"
            )
        if array.dtype == "float64" and not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
            raise InvalidInputError(
                f"{where}: array {name!r} must be float32, found float64 (or enable jax_enable_x64)"
            )
        if not np.all(np.isfinite(array)):
            raise InvalidInputError(f"{where}: array {name!r} must be finite")


def _of_dtype(shapes: ContactDynamics, dtype: np.dtype) -> ContactDynamics:
    """The same shapes in the file's precision, independent of this session's default."""

    def change(leaf: Any) -> Any:
        abstract = isinstance(leaf, jax.ShapeDtypeStruct)
        return jax.ShapeDtypeStruct(leaf.shape, dtype) if abstract else leaf

    return jax.tree.map(change, shapes)


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


def with_arrays(tree: _Tree, arrays: Mapping[str, np.ndarray], where: str) -> _Tree:
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


_FOLDER = Path(__file__).resolve().parent.parent / "pretrained"


def shipped_models() -> tuple[str, ...]:
    """Names of the models that come with the package, e.g. ``("pickup",)``."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.safetensors")))


def shipped_model(name: str) -> Path:
    """The file of a model that comes with the package: ``load_model(shipped_model("pickup"))``.

    Raises `InvalidInputError` where there is none of that name.
    """
    if name not in shipped_models():
        raise InvalidInputError(
            f"no model {name!r} comes with the package; those that do are "
            f"{', '.join(shipped_models()) or 'none'}"
        )
    return _FOLDER / f"{name}.safetensors"
