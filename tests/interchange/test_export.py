"""Round trips: what is imported, exported and imported again is the same to 1e-6."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from recordings import lerobot_folder, mcap_file, minari_folder, motive_file

from contactgraph.cli.main import run
from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Scene,
    Trajectory,
    read_trajectories,
    write_trajectories,
)
from contactgraph.interchange.draft import draft_map
from contactgraph.interchange.rosbag import read_rosbag

MOTIVE = """
dimension = 3
[time]
dt = 0.02
[[body]]
name = "hand"
actuated = true
position = "Hand.position"
orientation = { columns = "Hand.rotation", order = "xyzw" }
[[body]]
name = "block"
position = "Block.position"
orientation = { columns = "Block.rotation", order = "xyzw" }
[[control]]
columns = "Hand.position"
kind = "position"
body = "hand"
"""


def assert_same(one: object, other: object) -> None:
    """Scenes or trajectories are equal to 1e-6; NaN where the other is."""
    for field in fields(one):  # type: ignore[arg-type]
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.name == "scene":
            assert_same(a, b)
        elif field.name == "polygons" and a is not None:
            for mine, theirs in zip(a, b, strict=True):
                np.testing.assert_array_equal(mine, theirs)
        elif isinstance(a, np.ndarray):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-6, err_msg=field.name)
        elif field.name != "metadata":
            assert a == b, field.name


def assert_round_trip(first: Path, to: str, folder: Path) -> None:
    out, again = folder / f"as-{to}", folder / f"{to}.h5"
    assert run(["export", str(first), "--to", to, "--out", str(out)]) == 0
    options = ["--map", str(out / "map.toml"), "--out", str(again)]
    assert run(["import", to, str(out), *options]) == 0
    for one, other in zip(read_trajectories(first), read_trajectories(again), strict=True):
        assert_same(one, other)


@pytest.mark.parametrize(
    ("kind", "make", "name", "targets"),
    [
        ("minari", minari_folder, "fetch-push", ("minari", "lerobot", "csv")),
        ("lerobot", lerobot_folder, "pusht", ("lerobot", "minari", "csv")),
        ("csv", motive_file, "motive.toml", ("csv", "minari", "lerobot")),
        ("rosbag", mcap_file, "bag.toml", ("csv", "minari")),
    ],
)
def test_import_export_import(
    kind: str, make: Callable[[Path], Path], name: str, targets: tuple[str, ...], tmp_path: Path
) -> None:
    suffix = {"csv": ".csv", "rosbag": ".mcap"}.get(kind, "")
    source = make(tmp_path / f"source{suffix}")
    map_name = name
    if name.endswith(".toml"):
        text = MOTIVE if kind == "csv" else draft_map(read_rosbag(source))
        map_name = str(tmp_path / name)
        Path(map_name).write_text(text)
    first = tmp_path / "first.h5"
    assert run(["import", kind, str(source), "--map", map_name, "--out", str(first)]) == 0
    if name.endswith(".toml"):
        assert read_trajectories(first).trajectories[0].measured_at is not None
    for to in targets:
        assert_round_trip(first, to, tmp_path)


def everything() -> Trajectory:
    """A trajectory with every field that has a place in the formats, and one without a place."""
    rng = np.random.default_rng(0)
    steps, nodes = 5, 3
    scene = Scene(
        node_name=("hand", 'a "box"', "Käse"),
        node_type=("hand", "object", "object"),
        actuated=np.array([True, False, False]),
        dt=0.05,
        anchor=np.array([[np.nan, np.nan], [0.5, 0.5], [np.nan, np.nan]]),
        goal=np.array([1.0, 2.0]),
        gravity=np.array([0.0, -9.81]),
        mass=np.array([1.0, 2.0, 3.0]),
        radius=np.array([0.1, 0.2, 0.3]),
        size=np.array([[np.nan, np.nan], [0.1, 0.2], [0.3, 0.1]]),
        candidate_edges=np.array([[0, 1], [0, 2]]),
        static=np.array([False, False, True]),
        control_kind=("force", "force", "switch"),
        control_of=np.array([[True, True, False], [False] * 3, [False] * 3]),
        planes=np.array([[0.0, 1.0, 0.0]]),
        reach=np.array([[[-1.0, -1.0], [1.0, 2.0]], *np.full((2, 2, 2), np.nan)]),
        polygons=(np.array([[0, 0], [1, 0], [0, 1]]), np.array([[0, 0], [1, 0], [1, 1]])),
        polygon_of=np.array([1, 2]),
        pins=np.array([[0, 1]]),
        pin_points=rng.normal(size=(1, 2, 2)),
    )
    contact = np.zeros((steps + 1, nodes, nodes), dtype=bool)
    contact[2, [0, 1], [1, 0]] = True
    turn = rng.normal(size=(steps + 1, nodes, 1))
    turn[:, 0] = np.nan
    return Trajectory(
        scene,
        *rng.normal(size=(2, steps + 1, nodes, 2)),
        rng.normal(size=(steps, 3)),
        contact=contact,
        holding=contact,
        orientation=turn,
        angular_velocity=turn,
        tracked=rng.random((steps + 1, nodes)) > 0.5,
        measured_at=rng.random((steps + 1, nodes)),
    )


@pytest.mark.parametrize("to", ["minari", "lerobot", "csv"])
def test_every_field_comes_back(
    to: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = everything()
    first = tmp_path / "first.h5"
    write_trajectories(first, [one, one])
    assert_round_trip(first, to, tmp_path)
    assert "left out" not in capsys.readouterr().out
    drawn = replace(one, link_positions=np.zeros((6, 2, 2)))
    heavier = replace(one, scene=replace(one.scene, mass=np.ones(3)))
    write_trajectories(first, [drawn, heavier])
    assert run(["export", str(first), "--to", to, "--out", str(tmp_path / "less")]) == 0
    assert "left out: scene mass, link_positions" in capsys.readouterr().out


def test_what_cannot_be_exported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, data, out = everything(), tmp_path / "first.h5", tmp_path / "out"
    other = replace(one, scene=replace(one.scene, node_name=("hand", "box", "cheese")))
    write_trajectories(data, [one, other])
    assert run(["export", str(data), "--to", "csv", "--out", str(out)]) == 2
    assert "trajectory 1: node_name must be that of trajectory 0" in capsys.readouterr().err
    write_trajectories(data, [replace(one, scene=replace(one.scene, dt=0.03))])
    assert run(["export", str(data), "--to", "lerobot", "--out", str(out)]) == 2
    assert "steps of 0.03 s are 33.3333" in capsys.readouterr().err
    assert run(["export", str(data), "--to", "zip", "--out", str(out)]) == 2
    assert "--to must be one of minari, lerobot, csv" in capsys.readouterr().err
    out.mkdir()
    assert run(["export", str(data), "--to", "csv", "--out", str(out)]) == 2
    assert f"{out}: must not exist yet" in capsys.readouterr().err
    assert sorted(each.name for each in tmp_path.iterdir()) == ["first.h5", "out"]


def test_a_failed_export_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from contactgraph.interchange import csv_table
    from contactgraph.interchange.export_layout import ExportLayout, export_layout

    def full(*arguments: object) -> str:
        raise OSError("No space left on device")

    monkeypatch.setattr(ExportLayout, "map_text", full)
    with pytest.raises(InvalidInputError, match="cannot be written"):
        csv_table.write_csv(export_layout(Dataset((everything(),))), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_what_lerobot_reads_of_an_exported_dataset(tmp_path: Path) -> None:
    """Its own readers: pyarrow for the frames, pandas for the tasks, whose index is their text."""
    import pandas
    import pyarrow.parquet as parquet

    one, data, out = everything(), tmp_path / "first.h5", tmp_path / "out"
    write_trajectories(data, [one, one], {"task": 'it\'s a "task"'})
    assert run(["export", str(data), "--to", "lerobot", "--out", str(out)]) == 0
    frames = parquet.read_table(out / "data/chunk-000/file-000.parquet")
    action = np.array(frames["action"].to_pylist())
    np.testing.assert_array_equal(action, np.tile([*one.control, one.control[-1]], (2, 1)))
    assert frames["index"].to_pylist() == list(range(len(frames)))
    tasks = pandas.read_parquet(out / "meta/tasks.parquet")
    assert tasks.to_dict() == {"task_index": {'it\'s a "task"': 0}}
    episodes = pandas.read_parquet(out / "meta/episodes/chunk-000/file-000.parquet")
    assert episodes["tasks"].map(list).tolist() == [['it\'s a "task"']] * 2
    assert episodes["dataset_to_index"].tolist() == [len(frames) // 2, len(frames)]
