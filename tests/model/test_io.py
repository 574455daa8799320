"""A model file rebuilds the model bit for bit, or is refused in one line."""

import json
from pathlib import Path

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given, settings
from model_scenes import DT, PRESETS, preset

from contactgraph.data import InvalidInputError
from contactgraph.model import (
    HOLD,
    TOUCH,
    ActuationFit,
    ContactDynamics,
    EdgeType,
    GumbelSample,
    Impacts,
    ModelConfig,
    describe_model,
    load_model,
    module_arrays,
    save_model,
    shipped_model,
    shipped_models,
)
from contactgraph.model import (
    PRESETS as NAMED,
)


class FirmSample(eqx.Module):
    """A part that is not of this package."""

    share: jax.Array

    def __call__(self, type_probability, key):
        return self.share * type_probability


def firm(config: ModelConfig, *, key: jax.Array) -> ContactDynamics:
    model = PRESETS["recurrent"](config, key=key)
    return eqx.tree_at(lambda m: m.sample, model, FirmSample(jnp.asarray(0.5)))


TRAINING = {"command": "contactgraph train ä.h5", "seed": 3, "rmse_m": [0.001, None, True]}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("models") / "good.safetensors"
    save_model(path, preset("recurrent"), "ours-recurrent", CONFIG, TRAINING)
    return path


CONFIG = ModelConfig(2, 2, DT, width=16)
"""Of `preset`."""
SERVO = ActuationFit(100.0 * np.eye(2), np.zeros(2), 100.0, 15.0, residual=0.0)
STRUCK = Impacts(0.25, 0.5, None)
CONFIGS = {
    "hinges": ("paper-literal", ModelConfig(2, 2, DT, width=4, hinges=True)),
    "known distance": (
        "ours-recurrent",
        ModelConfig(3, 2, DT, width=4, learned_contact_distance=False),
    ),
    "edge types": (
        "ours",
        ModelConfig(2, 2, DT, width=4, edge_types=(HOLD, EdgeType("magnet"), TOUCH)),
    ),
    "types": (
        "ours",
        ModelConfig(
            *(2, 2, DT, 0.1),
            width=4,
            node_types=("ball", "hand"),
            actuation={"hand": SERVO},
            averaged=True,
            varying_mass=True,
            slowing={"ball": (np.float64(0.5), 2.0)},
            impacts={("ball", "hand"): Impacts(0.5, None, 2.0), ("ball", "plane"): STRUCK},
        ),
    ),
    "boxes that turn": (
        "ours",
        ModelConfig(
            *(3, 0, DT),
            width=4,
            node_types=("box",),
            plane_distance={"box": 0.0},
            turn_length=0.03,
            inertia={"box": np.array([0.5, 1.0, 1.5])},
            learned_contact_distance=False,
        ),
    ),
}


@pytest.mark.parametrize("name", [*NAMED, *CONFIGS])
def test_a_loaded_model_is_the_saved_one_bit_for_bit(name: str, tmp_path: Path) -> None:
    made_by, config = CONFIGS.get(name, (name, CONFIG))
    model = NAMED[made_by](config, key=jax.random.key(0))
    save_model(tmp_path / "model", model, made_by, config, TRAINING)
    stored = load_model(tmp_path / "model")
    assert stored.training == TRAINING
    assert eqx.tree_equal(stored.model, model)
    found, given = describe_model(tmp_path / "model").config, config
    plain = str(given).replace("np.float64(0.5)", "0.5")
    assert str(found).replace("[0.5, 1.0, 1.5]", "array([0.5, 1. , 1.5])") == plain


@pytest.mark.parametrize("name", shipped_models())
def test_every_shipped_file_loads_and_is_saved_unchanged(name: str, tmp_path: Path) -> None:
    stored = load_model(shipped_model(name))
    header, arrays = parts(shipped_model(name))
    assert header["format_version"] == 3
    assert stored.training == header["training"]
    assert module_arrays(stored.model).keys() == arrays.keys()
    for path, array in module_arrays(stored.model).items():
        np.testing.assert_array_equal(array, arrays[path])
    summary = describe_model(shipped_model(name))
    made_by = summary.preset, summary.config
    save_model(tmp_path / "again", stored.model, *made_by, stored.training)
    assert (tmp_path / "again").read_bytes() == shipped_model(name).read_bytes()


def test_the_summary_describes_the_file(good: Path) -> None:
    summary = describe_model(good)
    assert summary.training == TRAINING
    assert (summary.preset, summary.config) == ("ours-recurrent", CONFIG)
    assert summary.size == good.stat().st_size
    arrays = module_arrays(preset("recurrent"))
    assert summary.parameter_count == sum(array.size for array in arrays.values())


def refusal(path: Path) -> str:
    with pytest.raises(InvalidInputError) as caught:
        load_model(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


def parts(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    with safetensors.safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["contactgraph"])
    return header, safetensors.numpy.load_file(path)


def write(path: Path, header: object, arrays: dict[str, np.ndarray]) -> Path:
    text = header if isinstance(header, str) else json.dumps(header)
    safetensors.numpy.save_file(arrays, path, {"contactgraph": text})
    return path


def test_truncated_anywhere(good: Path, tmp_path: Path) -> None:
    content = good.read_bytes()
    for length in np.linspace(0, len(content) - 1, 60).astype(int):
        (tmp_path / "short").write_bytes(content[:length])
        refusal(tmp_path / "short")


@settings(max_examples=100, deadline=None)
@given(
    changes=st.lists(
        st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=4
    ),
    front=st.booleans(),
)
def test_a_changed_byte_is_reported_or_without_effect(
    changes: list[tuple[float, int]],
    front: bool,
    good: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    content = bytearray(good.read_bytes())
    for place, value in changes:
        content[int(place * (5000 if front else len(content)))] = value
    path = tmp_path_factory.getbasetemp() / "flipped"
    path.write_bytes(content)
    try:
        describe_model(path)
        stored = load_model(path)
    except InvalidInputError as error:
        assert "\n" not in str(error)
        return
    assert stored.training == TRAINING
    original = module_arrays(load_model(good).model)
    for name, array in module_arrays(stored.model).items():
        np.testing.assert_array_equal(array, original[name])


def test_files_of_another_kind(tmp_path: Path) -> None:
    assert "does not exist" in refusal(tmp_path / "none")
    assert "must be a file" in refusal(tmp_path)
    (tmp_path / "text").write_text("weights: none\n" * 20)
    assert "must be a model file (safetensors)" in refusal(tmp_path / "text")
    safetensors.numpy.save_file({"a": np.zeros(3)}, tmp_path / "other")
    assert "holds something else" in refusal(tmp_path / "other")


def config(**values: object):
    """A change of the header's configuration."""
    return lambda header: header["config"].update(values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda header: header.update(format="x"), "field 'format' must be 'contactgraph-model'"),
        (lambda header: header.update(format_version=2), "must be 3, found 2"),
        (lambda header: header.update(format_version=4), "must be 3, found 4"),
        (lambda header: header.update(format_version=True), "must be 3, found True"),
        (lambda header: header.pop("training"), "field 'training' is missing"),
        (lambda header: header.update(config=[]), "field 'config' is missing or of another type"),
        (lambda header: header.update(checksum="0"), "checksum does not fit"),
        (lambda header: header["training"].update(seed=4), "checksum does not fit"),
        (lambda header: header.update(preset="os.system"), "give their preset, os.system"),
        (lambda header: header.update(sensor={"miss": 2.0}), "sensor must be that of a model"),
        (lambda header: header.update(sensor={"loss": 0.5}), "sensor must be that of a model"),
        (config(size=1), "config: 'size' is unknown"),
        (config(contact_distance="wide"), "Expected `float`, got `str` - at `$.contact_distance`"),
        (config(contact_distance=True), "Expected `float`, got `bool`"),
        (config(hinges=1), "Expected `bool`, got `int` - at `$.hinges`"),
        (config(dimension=10**9), "dimension must be 0 to 1024, found 1000000000"),
        (config(dimension=2.5), "Expected `int`, got `float` - at `$.dimension`"),
        (config(driving_size=10**9), "driving_size must be 0 to 1024, found 1000000000"),
        (config(node_types=["a"] * 2000), "node_types must be 0 to 1024, found 2000"),
        (
            lambda header: header.update(
                sensor={"false_alarm": "x", "miss": 0.1, "reports_touch": True, "delay": 0}
            ),
            "sensor must be that of a model (Expected `float`, got `str` - at `$.false_alarm`)",
        ),
        (
            lambda header: header.update(
                sensor={"false_alarm": 0.1, "miss": 2.0, "reports_touch": True, "delay": 0}
            ),
            "sensor must be that of a model (miss must be 0 to 1, found 2.0)",
        ),
        (config(edge_types=[{"name": "hold"}] * 16), "edge_types must be 1 to 15"),
        (config(dt=-1), "dt must be a positive number of seconds, found -1.0"),
        (config(impacts=[1]), "Expected `object`, got `array`"),
        (config(actuation={"hand": {"matrix": [["x"]]}}), "could not convert string to float: 'x'"),
        (config(width=8), "array 'inference.message_passing."),
        (config(dimension=3), "checksum does not fit"),
    ],
)
def test_wrong_headers(change, message: str, good: Path, tmp_path: Path) -> None:
    header, arrays = parts(good)
    change(header)
    if "checksum" not in message:
        header["checksum"] = header.get("checksum", "") and fitting_checksum(header, arrays)
    assert message in refusal(write(tmp_path / "wrong", header, arrays))


def fitting_checksum(header: dict, arrays: dict[str, np.ndarray]) -> str:
    """So that a wrong file is refused for what is wrong with it, not for its checksum."""
    from contactgraph.model import io

    rest = {name: value for name, value in header.items() if name != "checksum"}
    return io._checksum(rest, arrays)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "header must be JSON"),
        ("[" * 100_000, "header must be JSON"),
        ('{"format": NaN}', "numbers must be finite, found NaN"),
        ("1", "field 'format' must be"),
        ("[]", "field 'format' must be"),
        (" " * 3_000_000, "header must be shorter than"),
    ],
)
def test_headers_that_are_none(text: str, message: str, good: Path, tmp_path: Path) -> None:
    assert message in refusal(write(tmp_path / "wrong", text, parts(good)[1]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda array: array[:-1], "must be float32 of shape (), found float32 of shape (1,)"),
        (lambda array: array.astype(np.float16), "must be F32 or F64, found F16"),
        (lambda array: array.astype(np.float64), "must be float32, found float64"),
        (lambda array: array * np.nan, "must be finite"),
        (lambda array: None, "is missing"),
    ],
)
def test_wrong_weights(change, message: str, good: Path, tmp_path: Path) -> None:
    header, arrays = parts(good)
    name = "features.contact_distance"
    changed = change(np.stack([arrays[name], arrays[name]]) if "(1,)" in message else arrays[name])
    arrays.pop(name)
    if changed is not None:
        arrays[name] = np.asarray(changed)
    header["checksum"] = fitting_checksum(header, arrays)
    found = refusal(write(tmp_path / "wrong", header, arrays))
    assert message in found
    assert name in found


def test_an_array_too_many(good: Path, tmp_path: Path) -> None:
    header, arrays = parts(good)
    arrays["extra"] = np.zeros(2, np.float32)
    header["checksum"] = fitting_checksum(header, arrays)
    assert "array 'extra' is not part of it" in refusal(write(tmp_path / "wrong", header, arrays))


@pytest.mark.usefixtures("double_precision")
def test_single_precision_weights_are_read_as_such_in_a_double_session(good: Path) -> None:
    arrays = module_arrays(load_model(good).model)
    assert {array.dtype for array in arrays.values()} == {np.dtype("float32")}


def test_unsupported_models_are_not_saved(tmp_path: Path) -> None:
    model, path, made_by = preset("recurrent"), tmp_path / "model", ("ours-recurrent", CONFIG)
    bad = eqx.tree_at(lambda model: model.features.contact_distance, model, jnp.array(jnp.nan))
    with pytest.raises(InvalidInputError, match=r"'features\.contact_distance' must be finite"):
        save_model(path, bad, *made_by)
    for training in ({"loss": np.nan}, {"when": object()}, {1: "number as key"}):
        with pytest.raises(InvalidInputError, match="training must hold only JSON values"):
            save_model(path, model, *made_by, training)

    other = eqx.tree_at(lambda model: model.sample, model, GumbelSample(0.3))
    for wrong in (other, preset("recurrent", width=8)):
        with pytest.raises(InvalidInputError, match="'ours-recurrent' makes another model"):
            save_model(path, wrong, *made_by)
    assert not list(tmp_path.iterdir())


def test_names_that_clash_and_keys_that_hide_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"two paths of the tree have this name"):
        module_arrays({"a": {"b": np.zeros(1)}, "a.b": np.zeros(1)})
    with pytest.raises(InvalidInputError, match="'key' is a typed random key"):
        module_arrays({"key": jax.random.key(0)})


def test_a_model_with_custom_parts_is_rebuilt_by_its_preset(tmp_path: Path) -> None:
    path, config = tmp_path / "model", ModelConfig(2, 2, DT, width=4)
    model = eqx.tree_at(
        lambda m: m.sample.share, firm(config, key=jax.random.key(0)), jnp.asarray(0.25)
    )
    save_model(path, model, "mine:firm", config)
    with pytest.raises(InvalidInputError, match="give their preset, mine:firm"):
        load_model(path)
    loaded = load_model(path, firm).model
    assert float(loaded.sample.share) == 0.25
    assert eqx.tree_equal(loaded, model)
    assert describe_model(path).config == config
