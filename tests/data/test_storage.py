"""Round trips, and reads during and after a write."""

import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from contactgraph.data import (
    CONTROL_KINDS,
    Dataset,
    InvalidInputError,
    Scene,
    Trajectory,
    read_trajectories,
    write_trajectories,
)
from contactgraph.data.dataset_file import ARRAYS, REQUIRED
from contactgraph.data.schema import fields_of

text = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=8)
metadata = st.dictionaries(
    text.filter(bool),
    st.one_of(text, st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), st.booleans()),
    max_size=4,
)


def regular(corners: int) -> np.ndarray:
    """[V, 2] a regular polygon."""
    angle = 2.0 * np.pi * np.arange(corners) / corners
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


@st.composite
def datasets(draw: st.DrawFn) -> Dataset:
    dimension, control_size = draw(st.integers(1, 3)), draw(st.integers(0, 3))
    dt = draw(st.floats(1e-4, 1.0))

    def numbers(*shape: int) -> np.ndarray:
        return draw(hnp.arrays(np.float64, shape, elements=st.floats(-1e300, 1e300)))

    def run() -> Trajectory:
        nodes, steps = draw(st.integers(1, 4)), draw(st.integers(1, 4))
        optional = {
            name: numbers(*shape) if draw(st.booleans()) else None
            for name, shape in {
                "anchor": (nodes, dimension),
                "goal": (dimension,),
                "mass": (nodes,),
                "radius": (nodes,),
            }.items()
        }
        for name in ("mass", "radius"):
            if optional[name] is not None:
                optional[name] = np.abs(optional[name])
        if optional["anchor"] is not None:
            optional["anchor"][0] = np.nan
        sides = st.floats(1e-3, 1e3)
        size = draw(st.none() | hnp.arrays(np.float64, (nodes, dimension), elements=sides))
        if size is not None:
            size[0] = np.nan
        edges = st.tuples(st.integers(0, nodes - 1), st.integers(0, nodes - 1))
        pairs = (
            draw(st.lists(edges.filter(lambda e: e[0] != e[1]), max_size=4)) if nodes > 1 else []
        )
        contact = draw(hnp.arrays(bool, (steps + 1, nodes, nodes)))
        contact |= contact.swapaxes(1, 2)
        actuated = draw(hnp.arrays(bool, nodes))
        kinds = st.lists(
            st.sampled_from(CONTROL_KINDS), min_size=control_size, max_size=control_size
        )
        angle = draw(hnp.arrays(np.float64, (steps + 1, nodes), elements=st.floats(-10.0, 10.0)))
        angle[0, 0] = np.nan
        quaternion = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle, 0.0 * angle], axis=2)
        turning = {
            "holding": contact & draw(hnp.arrays(bool, (steps + 1, 1, 1))),
            "orientation": quaternion if dimension == 3 else angle[..., None],
            "angular_velocity": quaternion[..., 1:] if dimension == 3 else angle[..., None],
        }
        box = np.array([[-1.0], [2.0]]) * np.ones(dimension)
        outlines = draw(st.none() | st.lists(st.integers(3, 6), max_size=3))
        joined = None
        if dimension != 2:
            outlines = None
        elif nodes > 1:
            joined = draw(st.none() | st.lists(st.permutations(range(nodes)), max_size=3))
        ends = None if joined is None else np.array([each[:2] for each in joined], int)
        scene = Scene(
            static=~actuated if draw(st.booleans()) else None,
            control_kind=tuple(draw(kinds)) if draw(st.booleans()) else None,
            control_of=draw(hnp.arrays(bool, (nodes, control_size))),
            planes=np.eye(dimension, dimension + 1) if draw(st.booleans()) else None,
            reach=np.where(actuated[:, None, None], box, np.nan) if draw(st.booleans()) else None,
            polygons=None if outlines is None else tuple(regular(each) for each in outlines),
            polygon_of=None if outlines is None else np.zeros(len(outlines), dtype=np.int64),
            pins=None if ends is None else ends.reshape(-1, 2),
            pin_points=None if joined is None else numbers(len(joined), 2, 2),
            node_name=tuple(draw(st.lists(text, min_size=nodes, max_size=nodes, unique=True))),
            node_type=tuple(draw(st.lists(text, min_size=nodes, max_size=nodes))),
            actuated=actuated,
            dt=dt,
            dimension=dimension,
            candidate_edges=np.array(pairs).reshape(-1, 2) if draw(st.booleans()) else None,
            size=size,
            metadata=draw(metadata),
            **optional,
        )
        return Trajectory(
            scene,
            numbers(steps + 1, nodes, dimension),
            numbers(steps + 1, nodes, dimension),
            numbers(steps, control_size),
            contact if draw(st.booleans()) else None,
            numbers(steps + 1, draw(st.integers(2, 4)), dimension) if draw(st.booleans()) else None,
            draw(hnp.arrays(bool, (steps + 1, nodes))) if draw(st.booleans()) else None,
            numbers(steps + 1, nodes) if draw(st.booleans()) else None,
            **{name: value for name, value in turning.items() if draw(st.booleans())},
        )

    return Dataset(tuple(run() for _ in range(draw(st.integers(1, 3)))), draw(metadata))


def assert_same(found: Dataset, expected: Dataset) -> None:
    assert found.metadata == expected.metadata
    assert {k: type(v) for k, v in found.metadata.items()} == {
        k: type(v) for k, v in expected.metadata.items()
    }
    assert len(found) == len(expected)
    for ours, theirs in zip(found, expected, strict=True):
        assert (ours.scene.dt, ours.scene.dimension) == (theirs.scene.dt, theirs.scene.dimension)
        assert ours.scene.metadata == theirs.scene.metadata
        for one, other in ((ours, theirs), (ours.scene, theirs.scene)):
            for name in fields_of(one):
                assert_same_field(getattr(one, name), getattr(other, name))


def assert_same_field(found: Any, expected: Any) -> None:
    assert type(found) is type(expected)
    if isinstance(found, np.ndarray):
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    elif isinstance(found, tuple) and found and not isinstance(found[0], str):
        for pair in zip(found, expected, strict=True):
            assert_same_field(*pair)
    else:
        assert found == expected


def one_run(value: float = 0.0, steps: int = 5, nodes: int = 2, **scene: object) -> Trajectory:
    names = tuple(f"node-{i}" for i in range(nodes))
    return Trajectory(
        Scene(names, ("object",) * nodes, np.arange(nodes) == 0, 0.05, **scene),
        np.full((steps + 1, nodes, 2), value),
        np.zeros((steps + 1, nodes, 2)),
        np.zeros((steps, 2)),
    )


@settings(max_examples=60, deadline=None)
@given(dataset=datasets(), compress=st.booleans())
def test_written_data_is_read_unchanged(
    dataset: Dataset, compress: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "round-trip.h5"
    write_trajectories(path, dataset, compress=compress)
    assert_same(read_trajectories(path), dataset)


def test_the_same_trajectories_make_the_same_bytes(tmp_path: Path) -> None:
    for name in ("first.h5", "second.h5"):
        write_trajectories(tmp_path / name, [one_run(1.0)], {"seed": 0})
    assert (tmp_path / "first.h5").read_bytes() == (tmp_path / "second.h5").read_bytes()


def test_bools_are_bytes_that_every_language_reads(tmp_path: Path) -> None:
    write_trajectories(tmp_path / "data.h5", [one_run()])
    with h5py.File(tmp_path / "data.h5") as file:
        assert file["trajectories/000000/actuated"].dtype == np.uint8


def test_compression_saves_space(tmp_path: Path) -> None:
    runs = [one_run(steps=500, nodes=5)]
    write_trajectories(tmp_path / "plain.h5", runs)
    write_trajectories(tmp_path / "small.h5", runs, compress=True)
    assert (tmp_path / "small.h5").stat().st_size < (tmp_path / "plain.h5").stat().st_size / 4


def test_long_metadata_and_many_chunks(tmp_path: Path) -> None:
    path, story = tmp_path / "long.h5", "long " * 100_000
    write_trajectories(path, [one_run(2.0, steps=400_000, nodes=3)], {"story": story})
    found = read_trajectories(path)
    assert found.metadata["story"] == story
    assert found.trajectories[0].position.shape == (400_001, 3, 2)


def test_trajectories_written_by_hand_keep_the_order_of_their_numbers(tmp_path: Path) -> None:
    write_trajectories(tmp_path / "a.h5", [one_run(float(i)) for i in range(11)])
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        for number in range(11):
            file.move(f"trajectories/{number:06d}", f"trajectories/{number}")
    values = [run.position[0, 0, 0] for run in read_trajectories(tmp_path / "a.h5")]
    assert values == list(range(11))


def test_the_unit_of_a_control_is_stored_where_all_of_it_is_force(tmp_path: Path) -> None:
    for kinds, unit in (
        (None, b"N"),
        (("force", "force"), b"N"),
        (("force", "switch"), None),
        (("position", "position"), None),
    ):
        write_trajectories(tmp_path / "a.h5", [one_run(control_kind=kinds)])
        with h5py.File(tmp_path / "a.h5") as file:
            assert file["trajectories/000000/control"].attrs.get("unit") == unit
        (found,) = read_trajectories(tmp_path / "a.h5")
        assert found.scene.control_kind == kinds


def test_the_layout_in_the_documentation_is_the_one_of_the_code() -> None:
    page = (Path(__file__).parents[2] / "docs" / "file-format.md").read_text(encoding="utf-8")
    line = re.compile(
        r"│   ├── (\w+) +\[(.*?)\]  (?:.*?unit \"(.*?)\")?.*?(\(optional\))?$", re.MULTILINE
    )
    described = {
        name: (tuple(axes.split(", ")), unit or None, not optional)
        for name, axes, unit, optional in line.findall(page)
    }
    assert described == {
        name: (field.axis, field.unit, name in REQUIRED) for name, field in ARRAYS.items()
    }


def test_the_examples_of_the_documentation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = Path(__file__).parents[2] / "docs" / "file-format.md"
    examples = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    datasets = []
    for example in examples:
        exec(compile(example, str(page), "exec"), {})
        datasets.append(read_trajectories("mine.h5"))
        assert datasets[-1].trajectories[0].scene.node_name == ("gripper", "box")
    assert [len(each) for each in datasets] == [3]
    assert {"lab": "Zürich"} in [each.metadata for each in datasets]


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"list": [1]}, "metadata 'list': must be a string, int of 64 bits, float or bool"),
        ({"big": 2**63}, "metadata 'big': must be a string, int of 64 bits"),
        ({"nul": "a\0b"}, "metadata 'nul': must be Unicode without NUL"),
        ({"half": "\ud800"}, "metadata 'half': must be Unicode without NUL"),
        ({"": 1}, "metadata '': the name must be a string that is not empty"),
    ],
)
def test_metadata_that_cannot_be_stored(tmp_path: Path, metadata: dict, message: str) -> None:
    path = tmp_path / "data.h5"
    write_trajectories(path, [one_run(1.0)])
    with pytest.raises(InvalidInputError, match=re.escape(message)):
        write_trajectories(path, [one_run(2.0)], metadata)
    with pytest.raises(InvalidInputError, match=re.escape(f"trajectories/000001: {message}")):
        write_trajectories(path, [one_run(), one_run(metadata=metadata)])
    assert read_trajectories(path).trajectories[0].position[0, 0, 0] == 1.0
    assert [file.name for file in tmp_path.iterdir()] == ["data.h5"], (
        "a failed write leaves nothing"
    )


def test_unwritable_paths(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"folder .* does not exist"):
        write_trajectories(tmp_path / "none" / "data.h5", [one_run()])
    with pytest.raises(InvalidInputError, match="must be a file, found a folder"):
        write_trajectories(tmp_path, [one_run()])


WRITER = """
import sys
import numpy as np
from contactgraph.data import Scene, Trajectory, write_trajectories

scene = Scene(("a", "b"), ("object", "object"), np.array([True, False]), 0.05)
print("ready", flush=True)
for value in range(1, 1_000_000):
    state = np.full((201, 2, 2), float(value))
    run = Trajectory(scene, state, state, np.full((200, 2), float(value)))
    write_trajectories(sys.argv[1], [run] * 4, {"value": value})
"""


def test_a_writer_killed_at_any_moment_leaves_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "data.h5"
    pauses = np.random.default_rng(0).uniform(0.0, 0.05, size=10)
    litter = 0
    for pause in pauses:
        write_trajectories(path, [one_run()], {"value": 0})
        writer = subprocess.Popen([sys.executable, "-c", WRITER, path], stdout=subprocess.PIPE)
        assert writer.stdout is not None
        writer.stdout.readline()
        time.sleep(pause)
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
        dataset = read_trajectories(path)
        for run in dataset:
            assert np.all(run.position == dataset.metadata["value"])
        for left in tmp_path.glob(".data.h5.*.tmp"):
            litter += 1
            left.unlink()
    assert [file.name for file in tmp_path.iterdir()] == ["data.h5"]
    assert litter > 0, "no writer was hit in the middle of a write: the test shows nothing"
