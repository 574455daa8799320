"""Model files: safetensors weights with a JSON header that rebuilds the model."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from contactgraph.data.atomic_file import atomic_write
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.json_fields import parse_json
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.presets import ModelConfig, Preset
from contactgraph.model.program_store import once
from contactgraph.model.serialization import (
    Description,
    build,
    describe,
    module_arrays,
    with_arrays,
)
from contactgraph.model.types import ModelState, Nodes

FORMAT = "contactgraph-model"
VERSION = 2
# A single entry, because safetensors writes several in an order that changes between processes.
_ENTRY = "contactgraph"
_HEADER_LIMIT = 2_000_000
_DTYPES = ("float32", "float64")


@dataclass(frozen=True)
class StoredModel:
    """A model and its training record."""

    model: ContactDynamics
    training: dict[str, Any] = field(default_factory=dict, repr=False)
    """Free-form JSON: command, seed, data, errors, versions, …"""


@dataclass(frozen=True)
class ModelSummary:
    """Content of a model file."""

    format_version: int
    model: Description
    """Constructor arguments, nested."""
    training: dict[str, Any]
    """Free-form JSON: command, seed, data, errors, versions, …"""
    dimension: int
    """D, degrees of freedom per node."""
    control_size: int
    """U"""
    dt: float
    """s"""
    parameter_count: int
    size: int
    """Size of the file, bytes."""


def save_model(
    path: str | Path,
    model: ContactDynamics,
    training: Mapping[str, Any] | None = None,
    preset: tuple[str, ModelConfig] | None = None,
) -> None:
    """Write a model to ``path``, atomically: the file is the old or the whole new one at any time.

    `training` is anything that JSON can represent. The same model gives the same bytes. `preset`,
    name ``module:factory`` and argument of the function that made the model, is stored where a part
    is not of this package. Raises `InvalidInputError` for such a part without it, for weights that
    are not finite, a `training` that is not JSON, or a folder that is not writable.
    """
    path = Path(path)
    arrays = module_arrays(model)
    _check_weights(arrays, str(path))
    header = {
        "format": FORMAT,
        "format_version": VERSION,
        "model": _described(model, preset),
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
        shapes = _shapes(header["model"], preset, path)
        arrays = {name: _weights(file, name, path) for name in file.keys()}  # noqa: SIM118
    _check_weights(arrays, str(path))
    if header.pop("checksum") != _checksum(header, arrays):
        raise InvalidInputError(f"{path}: checksum does not fit the content: the file is damaged")
    dtype = next(iter(arrays.values())).dtype if arrays else np.dtype("float32")
    model: ContactDynamics = with_arrays(_of_dtype(shapes, dtype), arrays, str(path))
    once(_check_fit, model, str(path))
    return StoredModel(model, header["training"])


def describe_model(path: str | Path) -> ModelSummary:
    """Content of a model file, from its header alone.

    Raises `InvalidInputError` as `load_model` does, but does not check the weights.
    """
    path = Path(path)
    with _opened(path) as (file, header):
        model = header["model"]
        own = "preset" in model
        shapes: Any = _config(model, path) if own else _shapes(model, None, path)
        sizes = [int(np.prod(file.get_slice(name).get_shape())) for name in file.keys()]  # noqa: SIM118
    return ModelSummary(
        format_version=header["format_version"],
        model=model,
        training=header["training"],
        dimension=shapes.dimension,
        control_size=shapes.control_size,
        dt=shapes.dt,
        parameter_count=sum(sizes),
        size=path.stat().st_size,
    )


def _described(model: ContactDynamics, preset: tuple[str, ModelConfig] | None) -> Description:
    try:
        return describe(model)
    except InvalidInputError:
        if preset is None:
            raise
        return {"preset": preset[0], "config": asdict(preset[1])}


def _shapes(description: Description, preset: Preset | None, path: Path) -> ContactDynamics:
    """The model with shapes in place of weights."""
    if "preset" not in description:
        return build(description, f"{path}: model")
    if preset is None:
        made_by = description["preset"]
        raise InvalidInputError(f"{path}: has parts of your own; give their preset, {made_by}")
    config = _config(description, path)
    return eqx.filter_eval_shape(lambda: preset(config, key=jax.random.PRNGKey(0)))


def _config(description: Description, path: Path) -> ModelConfig:
    try:
        return ModelConfig(**description["config"])
    except (KeyError, TypeError) as error:
        raise InvalidInputError(f"{path}: model.config must be a ModelConfig ({error})") from error


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
    for name, kind in {"model": dict, "training": dict, "checksum": str}.items():
        if not isinstance(header.get(name), kind):
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


def _check_fit(model: ContactDynamics, where: str) -> None:
    """Trace one step of two nodes, to check that the parts fit together."""
    still = jnp.zeros((2, model.coordinates))
    nodes = Nodes(jnp.array([True, False]), jnp.ones(2, bool), jnp.ones(1, bool))

    def step(control: jax.Array) -> ModelState:
        belief = model.initial_belief(still, still, nodes)
        return model.step(ModelState(still, still, belief), control, nodes)

    try:
        jax.eval_shape(step, jnp.zeros(model.control_size))
    except (TypeError, ValueError, ArithmeticError, LookupError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InvalidInputError(f"{where}: the model's parts do not fit ({reason})") from error


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
