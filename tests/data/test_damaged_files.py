"""Every fault of a file is reported in one line that names file, trajectory and field."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import example, given, settings

from contactgraph.data import (
    InvalidInputError,
    Scene,
    Trajectory,
    read_trajectories,
    write_trajectories,
)

STEPS, NODES = 4, 3


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A valid file of two runs with every field."""
    path = tmp_path_factory.mktemp("good") / "good.h5"
    rng = np.random.default_rng(0)
    scene = Scene(
        node_name=("gripper", "käse", "盒子"),
        node_type=("gripper", "object", "object"),
        actuated=np.array([True, False, False]),
        dt=0.05,
        anchor=np.array([[np.nan, np.nan], [0.2, 0.1], [np.nan, np.nan]]),
        goal=np.zeros(2),
        mass=np.ones(NODES),
        radius=np.ones(NODES),
        size=np.array([[np.nan, np.nan], [0.1, 0.2], [0.3, 0.1]]),
        candidate_edges=np.array([[0, 1], [0, 2]]),
        static=np.array([False, False, True]),
        control_kind=("force", "switch"),
        control_of=np.array([[True, True], [False, False], [False, False]]),
        planes=np.array([[0.6, 0.8, -1.0], [0.0, 1.0, 0.0]]),
        reach=np.array([[[-1.0, np.nan], [1.0, 2.0]], *np.full((2, 2, 2), np.nan)]),
        polygons=(np.array([[0, 0], [1, 0], [0, 1]]), np.array([[0, 0], [1, 0], [1, 1], [0, 1]])),
        polygon_of=np.array([2, 2]),
        pins=np.array([[0, 1], [2, 1]]),
        pin_points=rng.normal(size=(2, 2, 2)),
        metadata={"seed": 3},
    )
    state = rng.normal(size=(2, STEPS + 1, NODES, 2))
    contact = np.zeros((STEPS + 1, NODES, NODES), dtype=bool)
    control, link_positions = rng.normal(size=(STEPS, 2)), rng.normal(size=(STEPS + 1, 4, 2))
    contact[2, 0, 1] = contact[2, 1, 0] = True
    run = Trajectory(
        scene,
        *(state[0], state[1], control, contact, link_positions),
        holding=contact,
        orientation=rng.normal(size=(STEPS + 1, NODES, 1)),
        angular_velocity=rng.normal(size=(STEPS + 1, NODES, 1)),
    )
    write_trajectories(path, [run, run], {"task": "push"})
    return path


def refusal(path: Path) -> str:
    with pytest.raises(InvalidInputError) as caught:
        read_trajectories(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


def assert_same_or_refused(path: Path, original: Path) -> None:
    """Checksums cover all of the file, so a change is either found or without effect."""
    try:
        found = read_trajectories(path)
    except InvalidInputError as error:
        assert "\n" not in str(error)
        return
    for ours, theirs in zip(found, read_trajectories(original), strict=True):
        np.testing.assert_array_equal(ours.position, theirs.position)
        np.testing.assert_array_equal(ours.contact, theirs.contact)
        np.testing.assert_array_equal(ours.orientation, theirs.orientation)
        np.testing.assert_array_equal(ours.scene.planes, theirs.scene.planes)
        np.testing.assert_array_equal(ours.scene.reach, theirs.scene.reach)
        assert ours.scene.control_kind == theirs.scene.control_kind
        assert ours.scene.node_name == theirs.scene.node_name
        assert ours.scene.node_type == theirs.scene.node_type
        assert ours.scene.metadata == theirs.scene.metadata


def test_truncated_anywhere(good: Path, tmp_path: Path) -> None:
    content = good.read_bytes()
    for length in np.linspace(0, len(content) - 1, 50).astype(int):
        path = tmp_path / "short.h5"
        path.write_bytes(content[:length])
        refusal(path)


def test_everything_written_is_under_a_checksum(good: Path) -> None:
    """Structure has one from the v110 format on; arrays must ask for it; heaps have none."""
    arrays: list[str] = []

    def check(name: str, found: h5py.Group | h5py.Dataset) -> None:
        if isinstance(found, h5py.Dataset):
            arrays.append(name)
            assert found.fletcher32, name
            assert found.dtype.kind != "O", name
        for attribute in found.attrs:
            assert found.attrs.get_id(attribute).dtype.kind != "O", f"{name} {attribute}"

    with h5py.File(good) as file:
        assert good.read_bytes()[8] == 3, "superblock version"
        check("/", file)
        file.visititems(check)
    assert len(arrays) == 2 * 27


@settings(max_examples=100, deadline=None)
@given(
    changes=st.lists(
        st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=16
    )
)
@example(changes=[(0.0, 0)])
def test_flipped_bytes(
    changes: list[tuple[float, int]], good: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    content = bytearray(good.read_bytes())
    for place, value in changes:
        content[int(place * len(content))] = value
    path = tmp_path_factory.getbasetemp() / "flipped.h5"
    path.write_bytes(content)
    assert_same_or_refused(path, good)


@settings(max_examples=30, deadline=None)
@given(content=st.binary(max_size=200))
def test_bytes_that_are_no_hdf5(content: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "noise.h5"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + content)
    refusal(path)
    path.write_bytes(content)
    assert "must be a dataset in HDF5" in refusal(path)


def test_files_of_another_kind(tmp_path: Path) -> None:
    assert "does not exist" in refusal(tmp_path / "none.h5")
    assert "found a folder" in refusal(tmp_path)
    (tmp_path / "text.h5").write_text("position, velocity\n1, 2\n")
    assert "must be a dataset in HDF5" in refusal(tmp_path / "text.h5")
    (tmp_path / "empty.h5").touch()
    assert "must be a dataset in HDF5" in refusal(tmp_path / "empty.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["images"] = np.zeros(3)
    assert "attribute 'format' must be 'contactgraph-dataset'" in refusal(tmp_path / "other.h5")


def put(name: str, value: object) -> Callable[[h5py.File], None]:
    """Replace an array of the second run, keeping its name."""

    def change(file: h5py.File) -> None:
        group = file["trajectories/000001"]
        if name in group:
            del group[name]
        group[name] = value

    return change


def attribute(place: str, name: str, value: object) -> Callable[[h5py.File], None]:
    return lambda file: file[place].attrs.__setitem__(name, value)


def remove(name: str) -> Callable[[h5py.File], None]:
    return lambda file: file.__delitem__(name)


def with_nan(name: str) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[f"trajectories/000001/{name}"][1, 1] = np.nan

    return change


def with_other_control(file: h5py.File) -> None:
    put("control", np.zeros((4, 3)))(file)
    for name in ("control_kind", "control_of"):
        del file[f"trajectories/000001/{name}"]


RUN = "trajectories/000001"
STATE = np.zeros((STEPS + 1, NODES, 2))
HOLDING_WITHOUT_CONTACT = np.zeros((STEPS + 1, NODES, NODES), bool)
HOLDING_WITHOUT_CONTACT[3, [1, 2], [2, 1]] = True


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            with_nan("position"),
            f"{RUN}: position must be finite, found [nan, nan] for 'käse' at step 1",
        ),
        (with_nan("velocity"), f"{RUN}: velocity must be finite"),
        (with_nan("control"), f"{RUN}: control must be finite"),
        (put("position", np.zeros((5, 3))), f"{RUN}/position: must have shape (T+1, N, D)"),
        (
            put("position", STATE[:1]),
            f"{RUN}: position must have shape (T+1, N, D) = (T+1, 3, 2) with T >= 1",
        ),
        (put("velocity", STATE[1:]), f"{RUN}: velocity must have shape (T+1, N, D) = (5, 3, 2)"),
        (
            put("control", np.zeros((9, 2))),
            f"{RUN}: control must have shape (T, U) = (4, U), found (9, 2)",
        ),
        (
            put("control", np.zeros((4, 3))),
            f"{RUN}: control_kind must have shape (U,) = (3,), found (2,)",
        ),
        (with_other_control, "trajectory 1: control size U is 3, but 2 in trajectory 0"),
        (put("position", STATE.astype("S3")), f"{RUN}/position: must have shape (T+1, N, D) of"),
        (put("mass", [1.0]), f"{RUN}: mass must have shape (N,) = (3,), found (1,)"),
        (put("mass", [1.0, np.inf, 1.0]), f"{RUN}: mass must be finite"),
        (
            put("size", np.ones((3, 3))),
            f"{RUN}: size must have shape (N, D) = (3, 2), found (3, 3)",
        ),
        (put("size", [[1, 1], [1, 0], [1, 1]]), f"{RUN}: size must be positive, or NaN throughout"),
        (put("size", [[1, np.inf]] * 3), "found [1.0, inf] for 'gripper'"),
        (put("size", [[1, 1], [np.nan, 1], [1, 1]]), "found [nan, 1.0] for 'käse'"),
        (with_nan("link_positions"), "finite, found [nan, nan] in row 1 at step 1"),
        (
            put("link_positions", STATE[:3]),
            f"{RUN}: link_positions must have shape (T+1, L, D) = (5, L, 2)",
        ),
        (put("link_positions", STATE[..., :1]), "with L >= 2, found (5, 3, 1)"),
        (put("link_positions", STATE[:, :1]), "with L >= 2, found (5, 1, 2)"),
        (put("link_positions", STATE[0]), f"{RUN}/link_positions: must have shape (T+1, L, D) of"),
        (put("contact", np.full((5, 3, 3), 2)), f"{RUN}/contact: must hold only 0 and 1"),
        (put("contact", np.tri(3)[None].repeat(5, 0) > 0), f"{RUN}: contact must be symmetric"),
        (put("holding", np.zeros((5, 3, 2), bool)), f"{RUN}: holding must have shape (T+1, N, N)"),
        (put("holding", np.full((5, 3, 3), 3)), f"{RUN}/holding: must hold only 0 and 1"),
        (put("holding", np.tri(3)[None].repeat(5, 0) > 0), f"{RUN}: holding must be symmetric"),
        (
            put("holding", HOLDING_WITHOUT_CONTACT),
            f"{RUN}: holding must imply contact, found 'käse' holding '盒子' without contact at "
            "step 3",
        ),
        (
            put("orientation", STATE),
            f"{RUN}: orientation must have shape (T+1, N, 1|4) = (5, 3, 1)",
        ),
        (put("orientation", STATE[:, :, 0]), "orientation: must have shape (T+1, N, 1|4) of"),
        (
            put("orientation", np.full((5, 3, 1), np.inf)),
            f"{RUN}: orientation must be finite angles or quaternions of length 1, or NaN "
            "throughout where it is not known, found [inf] for 'gripper' at step 0",
        ),
        (
            put("angular_velocity", STATE),
            f"{RUN}: angular_velocity must have shape (T+1, N, 1|3) = (5, 3, 1)",
        ),
        (put("static", [0, 1]), f"{RUN}: static must have shape (N,) = (3,), found (2,)"),
        (put("static", [1, 0, 0]), "static must name nodes that are not actuated, found 'gripper'"),
        (put("control_kind", np.array([b"force", b"pull"])), "found 'pull'"),
        (
            put("control_kind", np.array([b"force"])),
            f"{RUN}: control_of must have shape (N, U) = (3, 1), found (3, 2)",
        ),
        (put("control_kind", [1, 2]), f"{RUN}/control_kind: must have shape (U,) of UTF-8 texts"),
        (put("control_of", np.ones((2, 2), bool)), f"{RUN}: control_of must have shape (N, U)"),
        (
            put("control_of", np.ones((3, 3), bool)),
            f"{RUN}: control_of must have shape (N, U) =",
        ),
        (put("planes", np.ones((1, 4))), f"{RUN}: planes must have shape (P, D+1) = (P, 3)"),
        (put("planes", [[1, 0, 0], [0.6, 0.9, 1]]), "found [0.6, 0.9, 1.0] in row 1"),
        (put("planes", [[1, 0, np.inf]]), f"{RUN}: planes must be a normal of length 1 and a fin"),
        (put("reach", np.ones((3, 2, 3))), f"{RUN}: reach must have shape (N, 2, D) = (3, 2, 2)"),
        (
            put("reach", [[[1, 0], [0, 1]]] * 3),
            f"{RUN}: reach must be lower bounds below upper ones, each finite or NaN for none, "
            "found [[1.0, 0.0], [0.0, 1.0]] for 'gripper'",
        ),
        (
            put("reach", np.full((3, 2, 2), np.inf)),
            f"{RUN}: reach must be lower bounds below upper ones, each finite or NaN for none, "
            "found [[inf, inf], [inf, inf]] for 'gripper'",
        ),
        (
            put("reach", [[[0, 0], [1, 1]]] * 3),
            f"{RUN}: reach must be NaN for nodes that are not actuated, found [[0.0, 0.0], [1.0, "
            "1.0]] for 'käse'",
        ),
        (put("polygons", np.ones((7, 2))), f"{RUN}: polygons[0] must be convex"),
        (put("polygons", np.full((7, 2), np.nan)), f"{RUN}: polygons[0] must be finite, found"),
        (
            put("polygons", np.ones((7, 3))),
            f"{RUN}: polygons[0] must have shape (V, D) = (V, 2) with V >= 3",
        ),
        (put("polygon_size", [3, 3]), "at least 3, 7 in total, found [3, 3]"),
        (
            put("polygon_size", [2, 5]),
            f"{RUN}: polygon_size must be numbers of corners",
        ),
        (put("polygon_size", [-(2**62), 2**62 + 7]), f"{RUN}: polygon_size must be numbers"),
        (put("polygon_of", [2, 3]), f"{RUN}: polygon_of must name nodes 0 to 2"),
        (put("polygon_of", [2]), f"{RUN}: polygon_of must have shape (Q,) = (2,), found (1,)"),
        (remove(f"{RUN}/polygon_of"), f"{RUN}: polygons and polygon_of must be given together"),
        (remove(f"{RUN}/polygon_size"), f"{RUN}: polygons and polygon_size must be given toget"),
        (remove(f"{RUN}/polygons"), f"{RUN}: polygons and polygon_size must be given together"),
        (put("pins", [[0, 1], [2, 3]]), "two different nodes of 0 to 2, found [2, 3] in row 1"),
        (put("pins", [[-1, 1], [2, 0]]), f"{RUN}: pins must join two different nodes of 0 to 2"),
        (put("pins", [[0, 1], [2, 2]]), "two different nodes of 0 to 2, found [2, 2] in row 1"),
        (put("pins", np.array([[0, 2**64 - 1]] * 2, np.uint64)), f"{RUN}: pins must join two"),
        (put("pins", [[0, 1]]), f"{RUN}: pin_points must have shape (J, 2, D) = (1, 2, 2)"),
        (put("pins", [0, 1]), f"{RUN}/pins: must have shape (J, 2) of integers"),
        (put("pins", [[0.0, 1.0], [1.0, 2.0]]), f"{RUN}/pins: must have shape (J, 2) of integers"),
        (put("pin_points", np.ones((2, 2, 3))), f"{RUN}: pin_points must have shape (J, 2, D)"),
        (put("pin_points", np.full((2, 2, 2), np.nan)), f"{RUN}: pin_points must be finite"),
        (put("pin_points", [[1, 0]]), f"{RUN}/pin_points: must have shape (J, 2, D) of floats"),
        (remove(f"{RUN}/pins"), f"{RUN}: pins and pin_points must be given together"),
        (remove(f"{RUN}/pin_points"), f"{RUN}: pins and pin_points must be given together"),
        (put("actuated", [1.0, 0.0, 0.0]), f"{RUN}/actuated: must have shape (N,) of bools"),
        (
            put("candidate_edges", [[0, 3]]),
            f"{RUN}: candidate_edges must join two different nodes of 0 to 2",
        ),
        (put("candidate_edges", [[1, 1]]), f"{RUN}: candidate_edges must join two different"),
        (put("node_name", np.array([b"a", b"b", b"a"])), f"{RUN}: node_name must be unique"),
        (
            put("node_name", ["a", "b", "c"]),
            f"{RUN}/node_name: must have shape (N,) of UTF-8 texts of fixed",
        ),
        (put("node_name", np.array([b"\xff", b"b", b"c"])), f"{RUN}/node_name: cannot be read"),
        (
            put("node_type", np.array([b"a"])),
            f"{RUN}: node_type must have shape (N,) = (3,), found (1,)",
        ),
        (put("node_type", [1, 2, 3]), f"{RUN}/node_type: must have shape (N,) of UTF-8 texts"),
        (remove(f"{RUN}/velocity"), f"{RUN}/velocity: is missing"),
        (remove("trajectories"), "trajectories: is missing"),
        (lambda file: file.create_group("trajectories/last"), "groups named 000000"),
        (lambda file: file["trajectories"].create_dataset("7", data=1), "7: must be a group"),
        (lambda file: file["trajectories"].clear(), "a dataset needs at least one trajectory"),
        (attribute(RUN, "dt", -0.05), f"{RUN}: dt must be a positive number of seconds"),
        (attribute(RUN, "dt", np.nan), f"{RUN}: dt must be a positive number of seconds"),
        (attribute(RUN, "dt", np.bytes_("1")), f"{RUN}: dt must be a number of seconds"),
        (attribute(RUN, "dt", [0.05]), f"{RUN}: attribute 'dt': must be one int, float"),
        (attribute(RUN, "dt", 0.1), "trajectory 1: dt in s is 0.1, but 0.05 in trajectory 0"),
        (attribute("/", "format_version", 3), "'format_version' must be 2, found 3"),
        (attribute("/", "format_version", 1), "'format_version' must be 2, found 1"),
        (attribute("/", "format_version", True), "'format_version' must be 2, found True"),
        (attribute("/", "format", np.bytes_("other")), "'format' must be 'contactgraph-dataset'"),
        (attribute("metadata", "list", [1, 2]), "metadata: attribute 'list': must be one int"),
        (
            attribute(f"{RUN}/position", "unit", np.bytes_("mm")),
            f"{RUN}/position: unit must be m, found mm",
        ),
    ],
)
def test_wrong_content(
    change: Callable[[h5py.File], None], message: str, good: Path, tmp_path: Path
) -> None:
    path = tmp_path / "wrong.h5"
    shutil.copy(good, path)
    with h5py.File(path, "r+") as file:
        change(file)
    assert message in refusal(path)


def test_an_hour_of_zeros_declared_but_not_stored(good: Path, tmp_path: Path) -> None:
    path = tmp_path / "huge.h5"
    for options in ({"chunks": (1000, 3, 2)}, {"chunks": (1000, 3, 2), "compression": "gzip"}, {}):
        shutil.copy(good, path)
        with h5py.File(path, "r+") as file:
            del file[f"{RUN}/position"]
            file[RUN].create_dataset("position", shape=(10**9, 3, 2), dtype="f8", **options)
        assert f"{RUN}/position: declares shape (1000000000, 3, 2)" in refusal(path)


def test_nothing_outside_the_file_is_followed(good: Path, tmp_path: Path) -> None:
    elsewhere, path = tmp_path / "elsewhere.h5", tmp_path / "linked.h5"
    shutil.copy(good, elsewhere)
    (tmp_path / "raw.bin").write_bytes(STATE.tobytes())
    virtual = h5py.VirtualLayout(STATE.shape, "f8")
    virtual[...] = h5py.VirtualSource(elsewhere, f"{RUN}/position", STATE.shape)
    raw = [(str(tmp_path / "raw.bin"), 0, STATE.nbytes)]
    outside = {
        "found a link": [
            put("position", h5py.ExternalLink(str(elsewhere), f"{RUN}/position")),
            put("position", h5py.SoftLink("/trajectories/000000/position")),
            put("node_name", h5py.ExternalLink(str(elsewhere), f"{RUN}/node_name")),
        ],
        "found data in another file": [
            lambda file: file[RUN].create_virtual_dataset("position", virtual),
            lambda file: file[RUN].create_dataset("position", STATE.shape, "f8", external=raw),
        ],
    }
    for message, changes in outside.items():
        for change in changes:
            shutil.copy(good, path)
            with h5py.File(path, "r+") as file:
                if message != "found a link":
                    del file[f"{RUN}/position"]
                change(file)
            assert re.search(
                f"{RUN}/(position|node_name): must be stored here, {message}", refusal(path)
            )


def test_integers_booleans_and_unknown_arrays_are_read(good: Path, tmp_path: Path) -> None:
    path = tmp_path / "other-types.h5"
    shutil.copy(good, path)
    with h5py.File(path, "r+") as file:
        put("position", STATE.astype(np.int16))(file)
        put("velocity", STATE.astype(np.float32))(file)
        put("actuated", np.array([True, False, False]))(file)
        put("camera", np.zeros(7))(file)
        del file["metadata"]
    run = read_trajectories(path).trajectories[1]
    assert run.position.dtype == run.velocity.dtype == np.float64
    assert run.scene.actuated.tolist() == [True, False, False]
