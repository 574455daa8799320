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
from scipy.spatial.transform import Rotation

from contactgraph.cli.main import run
from contactgraph.data import Dataset, InvalidInputError
from contactgraph.interchange import Column, Episode, Recording, to_trajectories
from contactgraph.interchange.conversion import state_after
from contactgraph.interchange.csv_table import read_csv
from contactgraph.interchange.draft import draft_map
from contactgraph.interchange.lerobot import read_lerobot
from contactgraph.interchange.measurements import MappedEpisode
from contactgraph.interchange.minari import read_minari
from contactgraph.interchange.motion import body_motions, motion_warnings
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
    with pytest.raises(InvalidInputError, match="a line of names, separated by a comma"):
        table(tmp_path, "0,1,2", ROWS.tolist())
    for above in ("", "# "):
        path = tmp_path / "spaces.csv"
        path.write_text(
            f"{above}time x y\n" + "".join("{:g} {:g}  {:g}\n".format(*row) for row in ROWS)
        )
        (one,) = imported(read_csv(path), XY)
        assert len(one.position) == 40 and speeds(one).max() == pytest.approx(0.3)


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
    assert "column 'ros_stamp' may time or count" in refused(recording, XY)
    (one,) = imported(recording, XY, time='columns = "ros_stamp"\n')
    assert len(one.position) == 40
    (one,) = imported(table(tmp_path, "timestep,x,y", ROWS.tolist()), XY)  # even: no harm
    assert speeds(one).max() == pytest.approx(0.3)
    days = [["2026-03-01", f"12:00:{time:06.3f}", *row] for time, *row in uneven]
    assert "column 'Date' may time" in refused(table(tmp_path, "Date,TimeOfDay,x,y", days), XY)


def test_rows_of_several_bodies_in_turn(tmp_path: Path, capsys) -> None:
    rows = [[n, k, 0.015 * n + k, k] for n in range(40) for k in range(2)]
    assert "frame must increase" in refused(table(tmp_path, "frame,id,x,y", rows), XY)
    recording = table(tmp_path, "id,x,y", [row[1:] for row in rows])
    (warning,) = motion_warnings(body_motions(Dataset(imported(recording, XY))))
    assert "positions of box alternate" in warning


def test_columns_that_count_or_time_rows_that_are_missing(tmp_path: Path) -> None:
    rows = ROWS[np.arange(40) != 20, 1:].tolist()
    counted = [[n + n // 20, *row] for n, row in enumerate(rows)]
    assert "column 'idx' may time or count" in refused(table(tmp_path, "idx,x,y", counted), XY)
    seconds = [[n // 20, *row] for n, row in enumerate(rows)]
    assert "column 'stamp.sec' may" in refused(table(tmp_path, "stamp.sec,x,y", seconds), XY)
    french = [[0.05 * n, *row] for (n, *row) in counted]
    (one,) = imported(table(tmp_path, "Temps (s),x,y", french), XY)
    assert speeds(one).max() == pytest.approx(0.3)


@pytest.mark.parametrize("flag", ["truncated", "done"])
def test_flags_end_episodes(tmp_path: Path, flag: str) -> None:
    rows = [[0.015 * n, k, n == 19 and k < 2] for k in range(3) for n in range(20)]
    found = imported(table(tmp_path, f"x,y,{flag}", rows), XY)
    assert [each.steps for each in found] == [19, 19, 19]
    assert max(speeds(each).max() for each in found) == pytest.approx(0.3)


def test_numbers_stand_for_constant_columns(tmp_path: Path) -> None:
    names = "p[0],p[1],p[2],force"
    recording = table(tmp_path, names, [[7, *row[1:], 2.5] for row in ROWS.tolist()])
    push = '[[control]]\ncolumns = ["force", 0]\nkind = "force"\nbody = "box"\nscale = 2\n'
    body = BODY.format('"p[1:3]"') + "actuated = true\norientation = { columns = [0.5] }\n"
    (one,) = imported(recording, body + push)
    np.testing.assert_array_equal(one.control, [[5.0, 0.0]] * 39)
    np.testing.assert_allclose(one.position[:, 0], ROWS[:, 1:])
    assert np.all(one.orientation == 0.5)
    for wrong in ('"p[2:1]"', '"p[2:4]"', "[]", '["p[0]", nan]', '["p[0]", true]'):
        assert "position" in refused(recording, BODY.format(wrong))


@pytest.mark.parametrize(
    ("names", "columns", "scale"),
    [
        ("x_mm,y_mm", '["x_mm", "y_mm"]', 0.001),
        ("x [cm],y [cm]", '["x [cm]", "y [cm]"]', 0.01),
        ("fix.longitude,fix.latitude", '["fix.longitude", "fix.latitude"]', 7e4),
        ("cx_px,cy_px", '["cx_px", "cy_px"]', 0.002),
    ],
)
def test_a_unit_in_a_name_needs_its_scale(
    tmp_path: Path, names: str, columns: str, scale: float
) -> None:
    recording = table(tmp_path, names, ROWS[:, 1:].tolist())
    assert "scale must be" in refused(recording, BODY.format(columns))
    if "mm" in names:  # the wrong way round
        wrong = BODY.format(f"{{ columns = {columns}, scale = 1000 }}")
        assert "'x_mm' is in mm: scale must be 0.001" in refused(recording, wrong)
    text = BODY.format(f"{{ columns = {columns}, scale = {scale} }}")
    assert speeds(imported(recording, text)[0]).max() == pytest.approx(0.3 * scale)


def test_positions_and_orientations_change_axes_together(tmp_path: Path) -> None:
    half = 0.5 * TIME  # about y, which points up
    rows = np.column_stack([ROWS[:, 1:], 0 * half, 0 * half, np.sin(half), 0 * half, np.cos(half)])
    recording = table(tmp_path, "x,y,z,q[0],q[1],q[2],q[3]", rows.tolist())
    place = "{{ columns = [{}], scale = [1, {}, 1] }}"
    up = SPACE + BODY.format(place.format('"x", "z", "y"', -1))
    turn = 'orientation = {{ columns = ["q[0]", {}, "q[3]"], order = "xyzw", scale = {} }}\n'
    whole = turn.format('"q[1]", "q[2]"', 1)
    said = refused(recording, up + whole)
    assert "box: position and orientation must be about the same axes" in said
    (one,) = imported(recording, up + turn.format('"q[2]", "q[1]"', "[1, -1, 1, 1]"))
    np.testing.assert_allclose(one.angular_velocity[:, 0], [[0, 0, 1]] * 40, atol=1e-3)
    (one,) = imported(recording, SPACE + BODY.format('["x", "y", "z"]') + whole)
    np.testing.assert_allclose(one.angular_velocity[:, 0], [[0, 1, 0]] * 40, atol=1e-3)


def test_poses_that_are_carried_forward_are_named(tmp_path: Path) -> None:
    rows = [[0.015 * (n // 5), 1] for n in range(100)]
    recording = table(tmp_path, "x,y", rows)
    (warning,) = motion_warnings(body_motions(Dataset(imported(recording, XY))))
    assert "positions of box change in every 5 steps alone" in warning


@pytest.mark.parametrize(
    ("touch", "message"), [((8, 850), "c must be 0 to 1, found 8 to 850"), ((0.08, 0.03), "")]
)
def test_contacts_are_from_0_to_1(tmp_path: Path, touch: tuple, message: str) -> None:
    rows = [[*row, 3, 1, touch[n > 20]] for n, row in enumerate(ROWS[:, 1:].tolist())]
    recording = table(tmp_path, "x,y,u,v,c", rows)
    other = BODY.replace("box", "b").format('["u", "v"]')
    text = f'{XY}{other}[[holding]]\nbodies = ["box", "b"]\ncolumns = "c"\n'
    if message:
        assert message in refused(recording, text)
    else:
        text = f"dimension = 2\n[time]\ndt = 0.05\n{text}"
        _, notes = to_trajectories(recording, parse_map("map", text))
        assert any("holding[0]: c is never above 0.5" in each for each in notes)


def test_true_and_false_are_numbers(tmp_path: Path) -> None:
    rows = [[*row, 3, 1, n > 20] for n, row in enumerate(ROWS[:, 1:].tolist())]
    other = BODY.replace("box", "b").format('["u", "v"]')
    pair = '[[contact]]\nbodies = ["box", "b"]\ncolumns = "c"\n'
    (one,) = imported(table(tmp_path, "x,y,u,v,c", rows), XY + other + pair)
    np.testing.assert_array_equal(one.contact[:, 0, 1], np.arange(40) > 20)


def test_numbers_that_are_no_quaternion_and_angles_in_another_order(tmp_path: Path) -> None:
    rows = np.column_stack([ROWS, 0 * TIME, 0 * TIME, 0 * TIME + 1, 0.5 * TIME])
    axis_angle = table(tmp_path, "time,x,y,a,b,c,d", rows.tolist())
    turn = 'orientation = { columns = ["a", "b", "c", "d"], order = "xyzw" }\n'
    assert "must have length 1, found" in refused(axis_angle, XY + turn)
    angles = table(tmp_path, "x,y,z,roll,pitch,yaw", rows[:, 1:].tolist())
    box = SPACE + BODY.format('["x", "y", "z"]')
    turn = 'orientation = { columns = ["roll", "pitch", "yaw"], euler = "ZYX" }\n'
    assert "must be in the order of euler, ZYX" in refused(angles, box + turn)


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
        (XY + "mass = -1\n", "mass must be finite and not negative"),
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
    first = '{ columns = ["q_x", "q_y", "q_z", "q_w"], order = "wxyz" }'
    assert "order, xyzw, found wxyz" in refused(named, XY + f"orientation = {first}\n")


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


def test_controls_in_another_frame_or_with_gaps_are_named(
    ros: tuple[Ros, Any], tmp_path: Path
) -> None:
    maker, recorded = ros
    messages = []
    for n in range(80):
        time = START + 0.05 * n
        messages.append((time, "/box", maker.stamped(time, 0.015 * n)))
        if not 20 <= n < 40:
            force = maker("geometry_msgs/Vector3", 8.0, 0.0, 0.0)
            wrench = maker("geometry_msgs/Wrench", force, force)
            stamped = maker("geometry_msgs/WrenchStamped", maker.header(time, "tool0"), wrench)
            messages.append((time, "/ft", stamped))
    control = '[[control]]\ncolumns = "/ft.wrench.force[0:2]"\nkind = "force"\nbody = "box"\n'
    text = f"dimension = 2\n[time]\ndt = 0.05\n{BOX}actuated = true\n{control}"
    _, notes = to_trajectories(recorded(messages), parse_map("map", text))
    assert any("control[0] is in the frame tool0, positions in world" in each for each in notes)
    assert any("control[0] has gaps of more than 0.5 s" in each for each in notes)
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "a.db3").write_bytes(b"SQLite format 3")
    with pytest.raises(InvalidInputError, match=r"no file that ends in \.mcap, found \.db3"):
        read_rosbag(tmp_path / "old")


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


def notes_of(recording: Recording, text: str) -> str:
    scene_map = parse_map("map", f"dimension = 2\ntime = {{ dt = 0.05 }}\n{text}")
    return "; ".join(to_trajectories(recording, scene_map)[1])


GOAL = 'goal = ["{0}", "{0}"]\n'
TWO = XY + BODY.replace("box", "hand").format('["y", "u"]')
DRIVEN = "actuated = true\n"
TARGET = '[[control]]\ncolumns = ["{}", "{}"]\nkind = "position"\nbody = "hand"\n'
OTHERS = TARGET.format("x", "y") + TARGET.format("y", "u").replace("hand", "box")
TOUCH = '[[contact]]\nbodies = ["box", "hand"]\ncolumns = {}\n'
SWITCH = '[[control]]\ncolumns = "s"\nkind = "switch"\n'
TURNED = '{}orientation = {{ columns = ["qw", "z", "z", "qz"], order = "wxyz" }}\n'
FLIPPED = '{ columns = ["x", "y"], scale = [1, -1] }'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOAL.format("g") + XY, "goal moves within an episode"),
        (GOAL.format("y") + XY, ""),
        (TWO + TOUCH.format('"c"'), "and none at 0.4 m: inverted?"),
        (TWO + TOUCH.format('"g"'), ""),
        (XY + TWO[len(XY) :] + DRIVEN + TARGET.format("y", "u"), ""),
        (XY + DRIVEN + TWO[len(XY) :] + DRIVEN + OTHERS, "targets of hand are where box is"),
        (XY + SWITCH, "s must be 0 to 1, found 0 to 255"),
        (XY + SWITCH + "scale = 0.00392157\n", ""),
        (TURNED.format(XY), ""),
        (TURNED.format(BODY.format(FLIPPED)), "its orientation is not: scale = -1?"),
        (TURNED.format(XY.replace('"x", "y"', '"y", "x"')), "its position is mirrored"),
    ],
)
def test_what_contradicts_the_motion_is_named(tmp_path: Path, text: str, message: str) -> None:
    """Goals, contacts, targets of another body, switches and mirrored poses."""
    near = TIME > 1.0
    columns = {
        "x": np.where(near, 0.6, 0.3 * TIME),
        "y": np.ones(40),
        "u": np.where(near, 1.0, 3.0 - TIME),
        "g": 0.0 + near,
        "c": 1.0 - near,
        "s": 255.0 * near,
        "z": np.zeros(40),
        "qw": np.cos(0.1 * TIME),
        "qz": np.sin(0.1 * TIME),
    }
    rows = np.stack([*columns.values()], axis=1).tolist()
    recording = table(tmp_path, ",".join(columns), rows)
    notes = [each for each in notes_of(recording, text).split("; ") if "not used" not in each]
    assert message in "; ".join(notes) and bool(message) == any(notes)


def test_a_slip_in_a_name_and_units_in_labels_are_refused(tmp_path: Path) -> None:
    rows = np.hstack([ROWS[:, 1:], ROWS[:, 1:]]).tolist()
    slip = table(tmp_path, "bowl_x,bowl_y,cup_x,cup_y", rows)
    message = refused(slip, BODY.format('["bowl_x", "cup_y"]'))
    assert "'bowl_x' goes with 'bowl_y', found 'cup_y'" in message
    folder = lerobot_frames(tmp_path / "d", [ROWS[:, 1:]], 20)
    info = json.loads((folder / "meta/info.json").read_text())
    (name,) = (each for each in info["features"] if "state" in each)
    info["features"][name]["names"] = ["tcp_x_mm", "tcp_y_mm"]
    (folder / "meta/info.json").write_text(json.dumps(info))
    message = refused(read_lerobot(folder), BODY.format(f'"{name}[0:2]"'))
    assert "'tcp_x_mm' is in mm: scale must be 0.001" in message


def test_copies_of_an_episode_and_one_in_other_units_are_named(tmp_path: Path) -> None:
    rows = [["a", *row] for row in ROWS.tolist()]
    twice = table(tmp_path, "episode,time,x,y", rows + [["b", *row[1:]] for row in rows])
    assert "episode b is that in a.csv: episode a: a copy?" in notes_of(twice, XY)
    scales = zip("abc", (1.0, 1.1, 1e3), strict=True)
    other = [[name, t, k * (x + 1), k * y] for name, k in scales for t, x, y in ROWS.tolist()]
    found = imported(table(tmp_path, "episode,time,x,y", other), XY)
    warned = "; ".join(motion_warnings(body_motions(Dataset(found))))
    assert "times as far from the origin as usual in one trajectory" in warned


def test_turn_rates_in_the_frame_of_the_body_are_named(tmp_path: Path) -> None:
    turn = Rotation.from_euler("xz", np.stack([0 * TIME + np.pi / 2, TIME], axis=1))
    w, x, y, z = np.roll(turn.as_quat(), 1, axis=1).T
    columns = [w, x, y, z, 0 * TIME, 0 * TIME, 0 * TIME + 1.0]
    rows = np.column_stack([ROWS, ROWS[:, 2], *columns]).tolist()
    recording = table(tmp_path, "time,x,y,z,qw,qx,qy,qz,wx,wy,wz", rows)
    box = SPACE + BODY.format('["x", "y", "z"]')
    box += 'orientation = { columns = ["qw", "qx", "qy", "qz"], order = "wxyz" }\n'
    for text, many in (("", 0), ('["wx", "wy", "wz"]', 0), ('["wx", "wz", "wy"]', 1)):
        keys = f"angular_velocity = {text}\n" if text else ""
        warned = motion_warnings(body_motions(Dataset(imported(recording, box + keys))))
        assert len(warned) == many and all("turn rates contradict" in each for each in warned)
