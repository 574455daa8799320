"""Recordings that contradict themselves, or their map, are read as they tell, or refused."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import (
    BODY,
    SPACE,
    XY,
    Ros,
    imported,
    lerobot_frames,
    mcap_file,
    minari_folder,
    motive_file,
    nexus_file,
    refused,
    robomimic_file,
    speeds,
    table,
)

from contactgraph.cli.main import run
from contactgraph.data import Dataset, InvalidInputError
from contactgraph.data.motion import body_motions, motion_warnings
from contactgraph.interchange import Column, Episode, to_trajectories
from contactgraph.interchange.conversion import state_after
from contactgraph.interchange.csv_table import read_csv
from contactgraph.interchange.draft import draft_map
from contactgraph.interchange.lerobot import read_lerobot
from contactgraph.interchange.measurements import MappedEpisode
from contactgraph.interchange.minari import read_minari
from contactgraph.interchange.robomimic import read_robomimic
from contactgraph.interchange.rosbag import read_rosbag
from contactgraph.interchange.scene_map import parse_map

START = 1.7e9
TIME = 0.05 * np.arange(40)
ROWS = np.column_stack([TIME, 0.3 * TIME, np.ones(40)]).round(6)
BOX = BODY.format('"/box.pose.position[0:2]"')


@pytest.fixture
def ros(tmp_path: Path) -> tuple[Ros, Any]:
    """Makes messages, and the recording of a bag of them."""
    maker = Ros()
    return maker, lambda messages: read_rosbag(maker.bag(tmp_path / "bag", messages))


def test_names_behind_a_hash_and_tables_without_names(tmp_path: Path) -> None:
    (one,) = imported(table(tmp_path, "# time,x,y", ROWS.tolist()), XY)
    assert len(one.position) == 40 and speeds(one).max() == pytest.approx(0.3)
    for header, above in (("0,1,2", ""), ("0 1 2", "# time x y\n")):
        with pytest.raises(InvalidInputError, match="a line of names, separated by commas"):
            table(tmp_path, header, ROWS.tolist(), above)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 20), st.integers(1, 10))
def test_rows_that_are_missing_are_steps(tmp_path_factory, first: int, count: int) -> None:
    """As empty rows, or by the numbers of frames."""
    folder = tmp_path_factory.mktemp("frames")
    lost = (np.arange(40) >= first) & (np.arange(40) < first + count)
    blank = [
        ["", ""] if gone else row for gone, row in zip(lost, ROWS[:, 1:].tolist(), strict=True)
    ]
    framed = np.column_stack([np.arange(40) + 7, ROWS[:, 1:]])[~lost]
    for recording in (
        table(folder, "x,y", blank),
        table(folder, "frame,x,y", framed.tolist()),
    ):
        (one,) = imported(recording, XY, time="max_gap = 9\n")
        assert len(one.position) == 40
        np.testing.assert_allclose(speeds(one), 0.3, rtol=1e-4)


@pytest.mark.parametrize("name", ["Time (s)", "time_s", "timestamp_ms", "Time [us]", "elapsed"])
def test_times_have_the_unit_of_their_name(tmp_path: Path, name: str) -> None:
    unit = {"ms": 1e-3, "us": 1e-6}.get(name.rstrip("])")[-2:], 1.0)
    uneven = ROWS[np.arange(40) != 20] / [unit, 1.0, 1.0]
    (one,) = imported(table(tmp_path, f"{name},x,y", uneven.tolist()), XY)
    assert len(one.position) == 40 and speeds(one).max() == pytest.approx(0.3)


@pytest.mark.parametrize("name", ["%time", "__time"])
def test_times_of_plotting_tools_are_times(tmp_path: Path, name: str) -> None:
    rows = [[f"{START + row[0]:.3f}", *row[1:]] for row in ROWS[np.arange(40) != 20].tolist()]
    (one,) = imported(table(tmp_path, f"{name},x,y", rows), XY)
    assert len(one.position) == 40 and speeds(one).max() == pytest.approx(0.3, rel=1e-3)
    rows = [[round((START + row[0]) * 1e9), *row[1:]] for row in ROWS.tolist()]
    assert "s in ns" in refused(table(tmp_path, f"{name},x,y", rows), XY)


def test_a_column_that_may_be_times_is_not_passed_over(tmp_path: Path) -> None:
    uneven = ROWS[np.arange(40) != 20].tolist()
    recording = table(tmp_path, "ros_stamp,x,y", uneven)
    assert "column 'ros_stamp' may be uneven times" in refused(recording, XY)
    (one,) = imported(recording, XY, time='columns = "ros_stamp"\n')
    assert len(one.position) == 40
    (one,) = imported(table(tmp_path, "timestep,x,y", ROWS.tolist()), XY)  # even: no harm
    assert speeds(one).max() == pytest.approx(0.3)
    days = [["2026-03-01", f"12:00:{time:06.3f}", *row] for time, *row in uneven]
    assert "column 'Date' may be" in refused(table(tmp_path, "Date,TimeOfDay,x,y", days), XY)


def test_rows_of_several_bodies_in_turn(tmp_path: Path, capsys) -> None:
    rows = [[n, k, 0.015 * n + k, k] for n in range(40) for k in range(2)]
    assert "frame must increase" in refused(table(tmp_path, "frame,id,x,y", rows), XY)
    recording = table(tmp_path, "id,x,y", [row[1:] for row in rows])
    (warning,) = motion_warnings(body_motions(Dataset(imported(recording, XY))))
    assert "positions of box alternate" in warning


def test_an_episode_that_is_named_once(tmp_path: Path) -> None:
    rows = [["" if n else k, 0.05 * n, 0.015 * n, 1] for k in (1, 2) for n in range(40)]
    with pytest.raises(InvalidInputError, match="episode must be in every row of numbers"):
        table(tmp_path, "episode,time,x,y", rows)


def test_a_column_of_a_thrust_is_no_time(tmp_path: Path) -> None:
    (one,) = imported(table(tmp_path, "x,y,T", [[*row[1:], 9.81] for row in ROWS.tolist()]), XY)
    assert speeds(one).max() == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("unit", "message"),
    [(60.0, "in min"), (86400.0, "in days"), (1.0 / 16.7e3, "rows are 835 s apart, but max_gap")],
)
def test_times_in_a_unit_that_is_not_told(tmp_path: Path, unit: float, message: str) -> None:
    rows = ROWS / [unit, 1.0, 1.0]
    assert message in refused(table(tmp_path, "time,x,y", rows.tolist()), XY)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("", "scale need columns"),
        (XY + "bounds = [[1, 1], [0, 0]]\n", "the lower corner, then the upper"),
        (XY + 'orientation = { columns = "x", axis = "y" }\n', "are for quaternions"),
        (XY + 'orientation = { columns = "x", turned_by = [0, 1, 0, 0] }\n', "are for quaternions"),
        (
            XY + 'orientation = { columns = ["x", "x", "x"], euler = "xyz", order = "wxyz" }\n',
            "order is for quaternions",
        ),
        (
            SPACE + BODY.format("[0, 0, 0]") + 'orientation = { columns = "x", axis = "x" }\n',
            "axis is for bodies of the plane",
        ),
        (BODY.format("[1, 1]") + "missing = 3\n", "missing is for recorded numbers"),
        (XY + "mass = -1\n", "mass must not be negative"),
        (
            '[[body]]\nname = "box"\n[body.keypoints]\ncolumns = ["x", "y", "x", "y"]\n',
            "'points' is missing",
        ),
    ],
)
def test_keys_that_cannot_be_meant(tmp_path: Path, key: str, message: str) -> None:
    recording = table(tmp_path, "time,x,y", ROWS.tolist())
    assert message in refused(recording, key or XY, time="" if key else "scale = 0.001\n")


def test_the_row_of_a_time_that_does_not_increase_is_named(tmp_path: Path) -> None:
    rows: list[list[Any]] = ROWS.tolist()
    rows[3][1:] = rows[4][1:] = ["", ""]
    rows[30][0] = rows[29][0]
    assert "[1.45, 1.45] s from row 30 on" in refused(table(tmp_path, "time,x,y", rows), XY)


def test_missing_is_a_number_as_recorded(tmp_path: Path) -> None:
    rows = [[t, 1000 * x, 1000 * y] for t, x, y in ROWS.tolist()]
    rows[10][1:] = rows[11][1:] = [-9999, -9999]
    scaled = BODY.format('{ columns = ["x", "y"], scale = 0.001 }') + "missing = -9999\n"
    (one,) = imported(table(tmp_path, "time,x,y", rows), scaled)
    assert speeds(one).max() == pytest.approx(0.3)


@pytest.mark.parametrize("uneven", [False, True])
def test_what_a_recording_calls_lost_is_not_tracked(tmp_path: Path, uneven: bool) -> None:
    rng = np.random.default_rng(0)
    time = TIME + 0.01 * uneven * rng.uniform(-1, 1, 40)
    rows = np.column_stack([time, 0.3 * time, 0 * time, abs(np.arange(40) - 20) > 5])
    (one,) = imported(table(tmp_path, "time,x,y,ok", rows.tolist()), XY + 'tracked = "ok"\n')
    assert 10 <= np.sum(~one.tracked[:, 0]) <= 12


def test_a_velocity_that_is_missing_is_derived(tmp_path: Path) -> None:
    rows: list[list[Any]] = np.column_stack([ROWS, 0 * TIME + 0.3, 0 * TIME]).tolist()
    rows[0][3] = rows[7][3] = ""
    (one,) = imported(table(tmp_path, "time,x,y,u,v", rows), XY + 'velocity = ["u", "v"]\n')
    np.testing.assert_allclose(speeds(one), 0.3, rtol=1e-6)


@pytest.mark.parametrize("mark", ["1.000", "1,5"])
def test_a_table_has_one_decimal_mark(tmp_path: Path, mark: str) -> None:
    (tmp_path / "a.csv").write_text(f"time;x;y\n0,05;{mark};0.5\n0,1;{mark};0.5\n")
    with pytest.raises(InvalidInputError, match="all have a decimal point, or all a comma"):
        read_csv(tmp_path / "a.csv")


def test_an_underscore_makes_no_number(tmp_path: Path) -> None:
    rows: list[list[Any]] = ROWS.tolist()
    rows[12][1] = "1_5"
    assert "'1_5' in row 13" in refused(table(tmp_path, "time,x,y", rows), XY)


def test_points_that_fit_no_pose(tmp_path: Path) -> None:
    points = np.array([[-0.06, -0.02], [0.06, -0.02], [0.06, 0.05], [-0.03, 0.02]])
    turn = 0.5 * TIME[:, None]
    cos, sin = np.cos(turn), np.sin(turn)
    x = points[:, 0] * cos - points[:, 1] * sin + 0.3 * TIME[:, None]
    y = points[:, 0] * sin + points[:, 1] * cos + 0.2
    names = [f"k{index}" for index in range(8)]

    def found(y: np.ndarray, scale: float = 1.0) -> tuple[Any, str]:
        values = np.column_stack([TIME, np.stack([x, y], axis=2).reshape(40, 8)])
        keys = f"columns = {json.dumps(names)}\nscale = {scale}\npoints = {points.tolist()}\n"
        recording = table(tmp_path, ",".join(["time", *names]), values.tolist())
        return recording, f'[[body]]\nname = "box"\n[body.keypoints]\n{keys}'

    for other in (found(-y), found(y, 0.001)):
        assert "points must fit the columns, but are off by" in refused(*other)
    lost = y.copy()
    lost[15:20, 2] = 0.0
    (one,) = imported(*found(lost))
    np.testing.assert_allclose(one.position[:, 0, 0], 0.3 * TIME, atol=0.005)
    assert 3 <= np.sum(~one.tracked[:, 0]) <= 5


def test_the_order_of_a_quaternion_is_that_of_the_recording(tmp_path: Path) -> None:
    ros = read_rosbag(mcap_file(tmp_path / "a.mcap"))
    body = SPACE + BODY.format('"/block/pose.pose.position"')
    turn = 'orientation = {{ columns = "/block/pose.pose.orientation"{} }}\n'
    (one,) = imported(ros, body + turn.format(""))
    np.testing.assert_allclose(np.abs(one.orientation[0, 0]), [1, 0, 0, 0], atol=0.02)
    assert "recording's order, xyzw, found wxyz" in refused(
        ros, body + turn.format(', order = "wxyz"')
    )
    take = read_csv(motive_file(tmp_path / "take.csv"))
    (one,) = imported(
        take,
        BODY.format('["Block.position[0]", "Block.position[2]"]')
        + 'orientation = { columns = "Block.rotation", axis = "y" }\n',
        1 / 120,
    )
    np.testing.assert_allclose(one.angular_velocity[:, 0, 0], 1.0, rtol=0.02)
    half = 0.5 * TIME
    rows = np.column_stack([ROWS, 0 * half, 0 * half, np.sin(half), np.cos(half)])
    named = table(tmp_path, "time,x,y,q_x,q_y,q_z,q_w", rows.tolist())
    (one,) = imported(named, XY + 'orientation = ["q_x", "q_y", "q_z", "q_w"]\n')
    untold = table(tmp_path, "x,y,a,b,c,d", rows[:, 1:].tolist())
    assert "order must be given" in refused(untold, XY + 'orientation = ["a", "b", "c", "d"]\n')
    np.testing.assert_allclose(one.orientation[:, 0, 0], TIME, atol=1e-4)
    first = '{ columns = ["q_x", "q_y", "q_z", "q_w"], order = "wxyz", axis = "x" }'
    (one,) = imported(named, XY + f"orientation = {first}\n")  # the map knows better than names
    assert np.isfinite(one.orientation).all()


@pytest.mark.parametrize(
    ("euler", "scale"),
    [("XYZ", np.pi / 180), ("zyx", np.pi / 180), ("ZYX", np.pi / 180), ("XYZ", 1)],
)
def test_euler_angles_of_motive_are_degrees(tmp_path: Path, euler: str, scale: float) -> None:
    head = "Format Version,1.23,Export Frame Rate,20,Rotation Type,XYZ,Length Units,Millimeters"
    parts = ",,Rotation,Rotation,Rotation,Position,Position,Position\nFrame,Time,X,Y,Z,X,Y,Z\n"
    rows = "".join(f"{n},{n / 20},0,{n},0,{15 * n},0,0\n" for n in range(40))
    path = tmp_path / "take.csv"
    path.write_text(f"{head}\n,Name{',Box' * 6}\n{parts}{rows}")
    text = SPACE + BODY.format('"Box.position"')
    turn = f'columns = "Box.rotation", euler = "{euler}", scale = {scale}'
    text += f"orientation = {{ {turn} }}\n"
    if euler == "ZYX" or scale == 1:
        message = refused(read_csv(path), text, None)
        wrong = "must be in the recording's order, XYZ" if scale < 1 else "are recorded in degrees"
        assert wrong in message
        return
    (one,) = imported(read_csv(path), text, None)
    np.testing.assert_allclose(
        np.linalg.norm(one.angular_velocity[:, 0], axis=1), np.pi / 9, rtol=1e-6
    )


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_angles_in_degrees_are_refused_or_named(tmp_path: Path, speed: float) -> None:
    rows = [[x, y, y, 0, 0, (speed * n + 180) % 360 - 180] for n, (_, x, y) in enumerate(ROWS)]
    recording = table(tmp_path, "x,y,z,roll,pitch,yaw", rows)
    box = SPACE + BODY.format('["x", "y", "z"]')
    euler = 'orientation = {{ columns = ["roll", "pitch", "yaw"], euler = "xyz"{} }}\n'
    assert "recorded in degrees: scale" in refused(recording, box + euler.format(""))
    (one,) = imported(recording, box + euler.format(", scale = 0.0174533"))
    rate = np.deg2rad(20 * speed)
    np.testing.assert_allclose(one.angular_velocity[:, 0, 2], rate, rtol=1e-4)
    planar = XY + 'orientation = "yaw"\n'
    if speed > 1:  # jumps from 180 to -180
        assert "recorded in degrees: scale" in refused(recording, planar)
    else:
        (warning,) = motion_warnings(body_motions(Dataset(imported(recording, planar))))
        assert "angles in degrees" in warning


def test_what_moves_by_a_control_has_one(tmp_path: Path) -> None:
    text = XY + "actuated = true\n"
    assert "needs a [[control]] with body = 'box'" in refused(
        table(tmp_path, "x,y", ROWS[:, 1:]), text
    )


def test_a_trial_of_nexus_that_excel_saved(tmp_path: Path) -> None:
    path = nexus_file(tmp_path / "trial.csv")
    rows = [line.split(",") for line in path.read_text().splitlines()]
    widest = max(map(len, rows))
    path.write_text("\n".join(",".join(row + [""] * (widest - len(row))) for row in rows))
    (one,) = imported(read_csv(path), BODY.format('"Box:A.position[0:2]"'), None)
    assert speeds(one).max() == pytest.approx(0.3)


def test_columns_of_other_rows_are_not_paired(tmp_path: Path, ros: tuple[Ros, Any]) -> None:
    maker, recorded = ros
    quaternion = maker("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
    messages = []
    for n in range(40):
        time = START + 0.05 * n
        turned = maker("geometry_msgs/QuaternionStamped", maker.header(time + 1.0), quaternion)
        messages += [(time, "/box", maker.stamped(time, 0.015 * n)), (time + 1.0, "/imu", turned)]
        clock = maker("std_msgs/Float64", 0.025 * n)
        messages += [(time, "/clock", clock), (time + 0.025, "/clock", clock)]
    recording = recorded(sorted(messages, key=lambda each: each[0]))
    assert "must have the times of the position" in refused(
        recording, BOX + 'orientation = "/imu.quaternion"\n'
    )
    message = refused(recording, BOX, time='columns = "/clock.data"\n')
    assert "must have a row for each of the others, 40, at the same times, found 80" in message
    path = tmp_path / "demo.hdf5"
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo["states"], demo["actions"] = np.zeros((40, 2)), np.zeros((30, 2))
    control = '[[control]]\ncolumns = "actions"\nkind = "force"\nbody = "box"\n'
    message = refused(
        read_robomimic(path), BODY.format('"states[0:2]"') + "actuated = true\n" + control
    )
    assert "found actions 30, states 40" in message


def test_totals_that_are_not_there_are_refused(tmp_path: Path) -> None:
    folder = minari_folder(tmp_path / "m", 3)
    (folder / "data" / "metadata.json").write_text('{"total_episodes": 5}')
    with pytest.raises(InvalidInputError, match="must have 5 episodes"):
        read_minari(folder)
    path = robomimic_file(tmp_path / "demo.hdf5")
    with h5py.File(path, "a") as file:
        file["data/demo_2/actions_abs"] = np.zeros((12, 3))
        assert "actions_abs" not in file["data/demo_10"]
    assert "actions_abs[3]" in draft_map(read_robomimic(path))
    with h5py.File(path, "a") as file:
        file["data/demo_2"].attrs["num_samples"] = 100
    with pytest.raises(InvalidInputError, match="must have 100 actions, as num_samples says"):
        read_robomimic(path)


@pytest.mark.parametrize("wrong", ["fps", "frame_index"])
def test_clocks_of_lerobot_that_contradict_each_other(tmp_path: Path, wrong: str) -> None:
    import pyarrow.parquet as parquet

    folder = lerobot_frames(tmp_path / "d", [ROWS[:, 1:]], 20)
    if wrong == "fps":
        info = json.loads((folder / "meta/info.json").read_text())
        (folder / "meta/info.json").write_text(json.dumps({**info, "fps": 5}))
    else:
        path = folder / "data/chunk-000/file-000.parquet"
        frames = parquet.read_table(path)
        frame = frames.schema.get_field_index("frame_index")
        jumped = np.arange(40) + 10 * (np.arange(40) > 20)
        parquet.write_table(frames.set_column(frame, "frame_index", [jumped]), path)
    with pytest.raises(InvalidInputError, match="timestamp must fit frame_index and fps"):
        read_lerobot(folder)


def test_files_of_a_folder_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for index in range(12):
        table(tmp_path, "x,y", [[index, 0], [index, 0]])
        (tmp_path / "a.csv").rename(tmp_path / f"take_{index}.csv")
    found = read_csv(tmp_path).episodes
    assert [each.columns["x"].values[0, 0] for each in found] == list(range(12))
    table(tmp_path, "x,y,cup", [[0, 0, 0], [0, 0, 0]])
    assert "cup[1]" in draft_map(read_csv(tmp_path))


def test_stamps_that_are_not_set_or_shared(ros: tuple[Ros, Any], tmp_path: Path) -> None:
    maker, recorded = ros
    messages = []
    for n in range(100):
        time = START + 0.1 * n
        messages.append((time, "/box", maker.stamped(time if n > 1 else 0.0, 0.03 * n)))
        messages.append((time, "/slow", maker.stamped(float(time // 1), 0.03 * n)))
    recording = recorded(messages)
    (one,) = imported(recording, BOX, 0.1)
    assert len(one.position) == 98 and speeds(one).max() == pytest.approx(0.3)
    scene_map = parse_map("map", f"dimension = 2\n[time]\ndt = 0.1\n{BOX}")
    unused = to_trajectories(recording, scene_map)[1][0]
    assert "2 messages without a stamp" in unused and "messages with another's stamp" in unused


def test_children_numbers_and_names_tell_which_body_it_is(ros: tuple[Ros, Any]) -> None:
    maker, recorded = ros
    messages = []
    for n in range(40):
        time, place = START + 0.05 * n, 0.015 * n
        header = maker.header(time)
        messages.append((time, "/mocap", maker.transform(time, "world", "box", place)))
        messages.append((time + 1e-4, "/mocap", maker.transform(time + 0.01, "world", "hand", 2.0)))
        pair = [maker.empty("visualization_msgs/msg/Marker") for _ in range(2)]
        for marker, number, at in zip(pair, (7, 9), (place, 2.0), strict=True):
            marker.header, marker.id, marker.pose = header, number, maker.pose(at)
        markers = pair if n % 3 else pair[::-1]
        messages.append((time, "/markers", maker("visualization_msgs/MarkerArray", markers)))
        values = np.array([place, 5.0, 2.0])
        names = ["finger", "finger", "wrist"]
        joints = maker("sensor_msgs/JointState", header, names, values, values, values)
        messages.append((time, "/joints", joints))
        links = [maker.transform(time, "world", f"link_{k}", place) for k in range(80)]
        messages.append((time, "/tf", maker("tf2_msgs/TFMessage", links)))
    recording = recorded(messages)
    for columns in (
        '"/mocap.transform.translation@box[0:2]"',
        '"/markers.markers.7.pose.position[0:2]"',
        '["/joints.position[0]", "/joints.position[0]"]',
        '"/tf.transforms.link_70.transform.translation[0:2]"',
    ):
        (one,) = imported(recording, BODY.format(columns))
        assert one.position[-1, 0, 0] == pytest.approx(0.585)
        assert speeds(one).max() < 0.5


def test_frames_that_contradict_the_map(ros: tuple[Ros, Any]) -> None:
    maker, recorded = ros
    still = maker("tf2_msgs/TFMessage", [maker.transform(0.0, "world", "table", 2.0)])
    messages = [(START - 0.5, "/tf_static", still)]
    for n in range(40):
        time = START + 0.05 * n
        messages.append((time, "/hand", maker.stamped(time, 1.0 + 0.015 * n)))
        messages.append((time, "/box", maker.stamped(time, 1.1 + 0.015 * n)))
    recording = recorded(messages)
    hand = BODY.replace("box", "hand").format('"/hand.pose.position[0:2]"')
    for key in ("in_frame_of", "relative_to"):
        message = refused(recording, f'{hand}{BOX}{key} = "hand"\n')
        assert "box: must be recorded in the frame of hand, found both in 'world'" in message
    table_map = BODY.replace("box", "table").format(
        '"/tf_static.transforms.table.transform.translation[0:2]"'
    )
    assert "table: must be measured more than once" in refused(recording, BOX + table_map)
    (one,) = imported(recording, f"{BOX}{table_map}static = true\n")
    np.testing.assert_allclose(one.position[:, 1, 0], 2.0)


@pytest.mark.parametrize(
    ("keys", "columns", "message"),
    [
        ("static = true\n", {}, "box is static, but moves"),
        (
            'orientation = "a"\nangular_velocity = "w"\n',
            {"a": 0.5 * TIME, "w": 0 * TIME + 28.65},
            "turn rates contradict orientations",
        ),
        ('orientation = "a"\n', {"a": 0.1 * TIME + np.pi / 2 * (TIME > 1.0)}, "turns jump: box"),
        ("", {}, ""),
    ],
)
def test_motions_that_cannot_be_are_named(
    tmp_path: Path, capsys, keys: str, columns: dict, message: str
) -> None:
    rows = np.column_stack([ROWS, *columns.values()])
    table(tmp_path, ",".join(["time", "x", "y", *columns]), rows.tolist())
    (tmp_path / "map.toml").write_text(f"dimension = 2\n[time]\ndt = 0.05\n{XY}{keys}", "utf-8-sig")
    where = ["--map", str(tmp_path / "map.toml"), "--out", str(tmp_path / "a.h5")]
    assert run(["import", "csv", str(tmp_path / "a.csv"), *where]) == 0
    warned = capsys.readouterr().err
    assert message in warned and bool(message) == bool(warned)


def test_what_is_left_out_is_told_and_nothing_is_overwritten(tmp_path: Path, capsys) -> None:
    late = [[*row, 1.0 if row[0] > 1.2 else ""] for row in ROWS.tolist()]
    rows = [["a", *row] for row in late] + [["b", 0.0, 1, 1, 1]]
    recording = tmp_path / "a.csv"
    table(tmp_path, "episode,time,x,y,f", rows)
    control = '[[control]]\ncolumns = ["f", "f"]\nkind = "force"\nbody = "box"\n'
    text = f"dimension = 2\n[time]\ndt = 0.05\n{XY}actuated = true\n{control}"
    (tmp_path / "map.toml").write_text(text)
    there = recording.read_bytes()
    where = ["import", "csv", str(recording), "--map", str(tmp_path / "map.toml"), "--out"]
    assert run([*where, str(tmp_path / "a.h5")]) == 0
    printed = capsys.readouterr().out
    assert "1.25 s are left out" in printed and "all is known: a.csv: episode b" in printed
    for name in ("a.csv", "map.toml"):
        assert run([*where, str(tmp_path / name)]) == 2
        assert "must not be the recording or the map" in capsys.readouterr().err
    assert recording.read_bytes() == there


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (b"#ROSBAG V2.0\n", "must be MCAP, but begins with b'#ROSBAG V2.0"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is a pointer of Git LFS"),
        (b"", "is empty"),
    ],
)
def test_files_of_another_kind_are_not_called_damaged(
    tmp_path: Path, head: bytes, message: str
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(head)
    with pytest.raises(InvalidInputError, match=message):
        read_rosbag(path)


def test_states_of_an_environment_follow_one_another() -> None:
    """As an adapted task reads them: `tracked` and a turn rate alone do not hinder the next one."""
    keys = 'tracked = "ok"\nangular_velocity = "w"\n'
    scene_map = parse_map("map", f"dimension = 2\n[time]\ndt = 0.05\n{XY}{keys}")
    previous = None
    for step in range(3):
        numbers = {"x": 0.1 * step, "y": 0.0, "ok": 1.0, "w": 0.5}
        columns = {name: Column(np.array([[value]])) for name, value in numbers.items()}
        previous = state_after(MappedEpisode(Episode("one", columns), scene_map, 0.05), previous)
    np.testing.assert_allclose(previous["velocity"], [[2.0, 0.0]])
