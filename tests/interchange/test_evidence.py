"""What a recording says of its own clock, frames, order and names counts, whatever the numbers."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from recordings import (
    BODY,
    SPACE,
    XY,
    Ros,
    imported,
    lerobot_frames,
    nexus_file,
    refused,
    robomimic_file,
    speeds,
    table,
)
from scipy.spatial.transform import Rotation

from contactgraph.cli.main import run
from contactgraph.data import InvalidInputError
from contactgraph.interchange import to_trajectories
from contactgraph.interchange.csv_table import read_csv
from contactgraph.interchange.draft import draft_map
from contactgraph.interchange.lerobot import read_lerobot
from contactgraph.interchange.minari import read_minari
from contactgraph.interchange.robomimic import read_robomimic
from contactgraph.interchange.rosbag import read_rosbag
from contactgraph.interchange.scene_map import parse_map

FEW = settings(max_examples=40, deadline=None)
SOME = settings(max_examples=10, deadline=None)
finite = st.floats(-3.0, 3.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings")


jitters = arrays(np.float64, 30, elements=st.floats(-0.4, 0.4))


@FEW
@given(st.floats(-8.0, 8.0), finite, jitters, st.booleans())
def test_angles_are_continued_before_they_are_interpolated(
    folder: Path, rate: float, start: float, jitter: np.ndarray, as_quaternion: bool
) -> None:
    time = 0.1 * (np.arange(30) + jitter)
    angle = start + rate * time
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    half = (
        np.stack([np.sin(angle / 2), np.cos(angle / 2)], 1) * np.where(jitter > 0, 1, -1)[:, None]
    )
    values = np.column_stack([time, 0.1 * time, 0 * time, wrapped, 0 * time, 0 * time, half])
    recording = table(folder, "time,x,y,yaw,qx,qy,qz,qw", values.tolist())
    turn = '{ columns = ["qx", "qy", "qz", "qw"], order = "xyzw" }' if as_quaternion else '"yaw"'
    (one,) = imported(recording, f"{XY}orientation = {turn}\n", 0.1)
    # Stamps that are uneven by up to 1 % of a step count as even.
    np.testing.assert_allclose(one.angular_velocity[:, 0, 0], rate, rtol=0.02, atol=1e-6)
    np.testing.assert_allclose(speeds(one), 0.1, rtol=0.02)


@FEW
@given(st.floats(-3.0, 3.0), arrays(np.float64, 3, elements=finite), st.booleans())
def test_a_body_that_lies_on_its_head_turns_as_it_does(
    folder: Path, rate: float, tilt: np.ndarray, mounted: bool
) -> None:
    time = 0.05 * np.arange(40)
    upright = Rotation.from_euler("z", 0.4 + rate * time[:, None])
    mount = Rotation.from_euler("x", 180, degrees=True) * Rotation.from_rotvec(0.03 * tilt)
    values = np.column_stack([time, time, time, (upright * mount).as_quat()])
    by = np.roll(mount.as_quat(), 1).tolist()
    turned = f", turned_by = {by}" if mounted else ""
    turn = f'{{ columns = ["qx", "qy", "qz", "qw"], order = "xyzw"{turned} }}'
    recording = table(folder, "time,x,y,qx,qy,qz,qw", values.tolist())
    (one,) = imported(recording, f"{XY}orientation = {turn}\n")
    np.testing.assert_allclose(one.angular_velocity[:, 0, 0], rate, atol=0.15 + 1e-6)
    if mounted:
        np.testing.assert_allclose(one.orientation[:, 0, 0], 0.4 + rate * time, atol=1e-9)


def test_a_turn_that_is_undefined_is_refused(folder: Path) -> None:
    over = Rotation.from_euler("x", np.linspace(0, np.pi, 20)[:, None])
    values = np.column_stack([0.05 * np.arange(20), np.zeros((20, 2)), over.as_quat()])
    turn = 'orientation = { columns = ["qx", "qy", "qz", "qw"], order = "xyzw" }\n'
    recording = table(folder, "time,x,y,qx,qy,qz,qw", values.tolist())
    assert "the turn about z is undefined in row 19" in refused(recording, XY + turn)


@FEW
@given(arrays(np.float64, 2, elements=finite), st.integers(2, 30), st.floats(0.01, 0.2))
def test_the_first_velocity_is_that_of_the_next_interval(
    folder: Path, velocity: np.ndarray, rows: int, dt: float
) -> None:
    time = dt * np.arange(rows)
    recording = table(
        folder, "time,x,y", np.column_stack([time, time[:, None] * velocity]).tolist()
    )
    (one,) = imported(recording, XY, dt)
    np.testing.assert_allclose(one.velocity[:, 0], np.tile(velocity, (rows, 1)), atol=1e-9)


@FEW
@given(st.sampled_from([("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)]), st.floats(0.01, 0.3))
def test_times_in_other_units_are_scaled_or_refused(
    folder: Path, unit: tuple[str, float], dt: float
) -> None:
    stamps = [round(1_700_000_000 / unit[1] + n * dt / unit[1]) for n in range(30)]
    rows = [(stamp, 0.5 * unit[1] * (stamp - stamps[0]), 1) for stamp in stamps]
    recording = table(folder, "timestamp,x,y", rows)
    (one,) = imported(recording, XY, dt, f'columns = "timestamp"\nscale = {unit[1]!r}\n')
    np.testing.assert_allclose(speeds(one), 0.5, rtol=0.02)
    assert f"s in {unit[0]}: [time] columns with scale = {unit[1]:g}" in refused(recording, XY, dt)


@pytest.mark.parametrize("form", ["2026-03-01 {}", "2026-03-01T{}Z", "2026-03-01T{}+02:00"])
def test_iso_times_are_read_and_other_texts_refused(folder: Path, form: str) -> None:
    rows = [
        (form.format(f"10:00:{n * 20 // 1000:02d}.{n * 20 % 1000:03d}"), 0.01 * n, 0)
        for n in range(60)
        if not 20 <= n < 40
    ]
    (one,) = imported(table(folder, "timestamp,x,y", rows), XY, 0.02)
    np.testing.assert_allclose(speeds(one), 0.5)
    rows[3] = ("noon", 0, 0)
    said = refused(table(folder, "timestamp,x,y", rows), XY, 0.02)
    assert "column 'timestamp' must be s or ISO 8601 times, found" in said


@FEW
@given(st.permutations([(e, n) for e in "ab" for n in range(6)]))
def test_rows_of_an_episode_belong_together(folder: Path, order: list) -> None:
    rows = sorted(order, key=lambda each: each[1])  # by time; the episodes in any order
    values = [(e, 0.05 * n, 0.015 * n + 5 * (e == "b"), 1) for e, n in rows]
    found = imported(table(folder, "episode,time,x,y", values), XY)
    assert len(found) == 2
    for each in found:
        np.testing.assert_allclose(speeds(each), 0.3)


def test_tables_of_other_programs(folder: Path) -> None:
    rows = [(n, 0.05 * n, 0.015 * n, 1) for n in range(20)]
    for header, above in ((",time,x,y", ""), ("i,time,x,y", "# a comment\n# and more\n")):
        (one,) = imported(table(folder, header, rows, above), XY)
        np.testing.assert_allclose(speeds(one), 0.3)
    path = folder / "excel.csv"
    lines = [";".join(f"{v:g}".replace(".", ",") for v in row[1:]) for row in rows]
    path.write_text("sep=;\ntime;x;y\n" + "\n".join(lines))
    (one,) = imported(read_csv(path), XY)
    np.testing.assert_allclose(speeds(one), 0.3)
    assert 'position = ["x", "y"]' in draft_map(table(folder, "time,x,y", [r[1:] for r in rows]))


def test_an_export_of_vicon_nexus(folder: Path) -> None:
    recording = read_csv(nexus_file(folder / "trial.csv"))
    assert recording.dt == pytest.approx(0.01) and "Devices" in recording.episodes[0].others
    text = BODY.format('"Box:A.position[0:2]"') + BODY.format('"Box:Box.position[0:2]"')
    (one,) = imported(recording, text.replace('"box"', '"other"', 1), None)
    np.testing.assert_allclose(speeds(one, 0), 0.3)
    np.testing.assert_allclose(speeds(one, 1), 0.3)
    turn = recording.episodes[0].columns["Box:Box.rotation"].values[-1]
    np.testing.assert_allclose(turn, [0, 0, np.deg2rad(90 * 39 / 40)])


@FEW
@given(st.integers(10, 200), st.floats(0.02, 0.2), st.integers(5, 50), st.integers(0, 10))
def test_frames_of_lerobot_have_their_own_times(
    tmp_path_factory: pytest.TempPathFactory, fps: int, dt: float, at: int, dropped: int
) -> None:
    time = np.arange(60) / fps
    time[at:] += dropped / fps
    state = np.stack([0.3 * time, 0 * time], 1)
    folder = lerobot_frames(tmp_path_factory.mktemp("lerobot"), [state], fps, [time])
    text = BODY.format('"observation.state"')
    try:
        found = imported(read_lerobot(folder), text, dt)
    except InvalidInputError as error:
        assert "no step" in str(error)  # the pieces between gaps are shorter than a step
        return
    for each in found:
        np.testing.assert_allclose(speeds(each), 0.3, rtol=0.02)
        assert each.scene.dt == dt


def test_episodes_of_lerobot_are_as_many_as_told(tmp_path: Path) -> None:
    line = np.stack([np.arange(10.0), np.zeros(10)], 1)
    twice = lerobot_frames(tmp_path / "a", [line, line], 10, numbers=[0, 0])
    assert len(read_lerobot(twice).episodes) == 2, "its frame numbers begin again"
    info = twice / "meta" / "info.json"
    info.write_text(info.read_text().replace('"total_episodes": 2', '"total_episodes": 3'))
    with pytest.raises(InvalidInputError, match=r"must have 3 episodes, as meta/info\.json says"):
        read_lerobot(twice)
    again = lerobot_frames(tmp_path / "b", [line, line], 10, firsts=[0, 0])
    with pytest.raises(InvalidInputError, match="index must be different in all frames"):
        read_lerobot(again)


@pytest.mark.parametrize("rows", [10, 11])
def test_infos_belong_to_the_states_after_steps(tmp_path: Path, rows: int) -> None:
    (tmp_path / "data").mkdir()
    with h5py.File(tmp_path / "data" / "main_data.hdf5", "w") as file:
        x = 2.0 + 0.1 * np.arange(11)
        file["episode_0/observations/hand"] = np.stack([0 * x, x], 1)
        file["episode_0/infos/box"] = np.stack([x, 0 * x], 1)[11 - rows :]
        file["episode_0/actions"] = np.zeros((10, 2))
    text = BODY.format('"observations/hand"') + BODY.format('"infos/box"').replace("box", "b", 1)
    (one,) = imported(read_minari(tmp_path), text, 0.1)
    assert one.steps == rows - 1
    np.testing.assert_allclose(one.position[:, 0, 1], one.position[:, 1, 0], atol=1e-9)


def test_demonstrations_of_robomimic(tmp_path: Path) -> None:
    recording = read_robomimic(robomimic_file(tmp_path / "demo.hdf5"))
    assert (recording.environment, recording.dt) == ("Lift", 0.05)
    control = '[[control]]\ncolumns = "actions[0:3]"\nkind = "other"\n'
    text = SPACE + BODY.format('"obs/object"') + control
    found = imported(recording, text, None)
    assert [each.position[0, 0, 2] for each in found] == [2.0, 10.0]
    assert all(each.control.shape == (12, 3) for each in found)
    np.testing.assert_allclose(speeds(found[0]), 0.3)
    (slower, _) = imported(recording, text, 0.1)
    np.testing.assert_allclose(speeds(slower), 0.3)
    assert slower.steps == 6


POSE = BODY.format('"/box.pose.position[0:2]"')


@SOME
@given(st.integers(5, 50), st.floats(0.3, 100.0), st.booleans())
def test_a_clock_that_is_set_back_ends_an_episode(
    tmp_path_factory: pytest.TempPathFactory, at: int, back: float, recorder: bool
) -> None:
    ros, messages = Ros(), []
    for n in range(60):
        time = 1.7e9 + 0.05 * n - back * (n >= at)
        recorded = time if recorder else 1.7e9 + 0.05 * n
        messages.append((recorded, "/box", ros.stamped(time, 0.015 * n)))
    messages[2], messages[3] = messages[3], messages[2]  # a single one that comes late
    found = imported(read_rosbag(ros.bag(tmp_path_factory.mktemp("bag") / "b", messages)), POSE)
    assert [len(each.position) for each in found] == [at, 60 - at]
    for each in found:
        np.testing.assert_allclose(speeds(each), 0.3, atol=1e-6)


@SOME
@given(st.integers(0, 3), st.booleans())
def test_simulated_time_from_zero_on(
    tmp_path_factory: pytest.TempPathFactory, begin: int, commanded: bool
) -> None:
    ros, messages, text = Ros(), [], POSE
    for n in range(begin, 40):
        messages.append((1.7e9 + 0.05 * n, "/box", ros.stamped(0.05 * n, 0.015 * n)))
        if commanded:
            layout = ros("std_msgs/MultiArrayLayout", [], 0)
            command = ros("std_msgs/Float64MultiArray", layout, np.array([0.1 * n, 0.0]))
            messages.append((1.7e9 + 0.05 * n, "/cmd", command))
    recording = read_rosbag(ros.bag(tmp_path_factory.mktemp("bag") / "b", messages))
    if not commanded:
        np.testing.assert_allclose(speeds(imported(recording, text)[0]), 0.3, atol=1e-6)
        return
    text += 'actuated = true\n[[control]]\ncolumns = "/cmd.data"\nkind = "force"\nbody = "box"\n'
    assert "do not overlap" in refused(recording, text)


def test_frames_are_kept_apart(tmp_path: Path) -> None:
    ros, messages = Ros(), []
    for n in range(40):
        at = 1.7e9 + 0.05 * n
        both = [ros.transform(at, f"/cam_{c}", "tag", 0.01 * n - 2 * (c == "b")) for c in "ab"]
        messages.append((at, "/tf", ros("tf2_msgs/TFMessage", both)))
        messages.append((at, "/box", ros.stamped(at, 0.015 * n, "map" if n < 20 else "odom")))
        messages.append((at, "/one", ros.stamped(at, 0.015 * n, "/map" if n < 20 else "map")))
    recording = read_rosbag(ros.bag(tmp_path / "b", messages))
    column = "/tf.transforms.tag.transform.translation"
    assert {f"{column}@cam_a", f"{column}@cam_b"} <= set(recording.episodes[0].columns)
    said = refused(recording, BODY.format(f'"{column}[0:2]"'))
    assert f"numbers in several frames: {column}@cam_a, {column}@cam_b" in said
    (one,) = imported(recording, BODY.format(f'"{column}@cam_b[0:2]"'))
    np.testing.assert_allclose(speeds(one), 0.2, atol=1e-6)
    assert "several frames" in refused(recording, POSE)
    (one,) = imported(recording, POSE.replace("/box", "/one"))
    np.testing.assert_allclose(speeds(one), 0.3, atol=1e-6)
    two = BODY.format(f'"{column}@cam_a[0:2]"').replace("box", "a", 1)
    said = refused(recording, two + POSE.replace("/box.", "/one."))
    assert "must be in one frame, found a in 'cam_a', box in 'map'" in said


@SOME
@given(st.lists(st.permutations("xyz"), min_size=30, max_size=30), st.booleans())
def test_joints_have_names(
    tmp_path_factory: pytest.TempPathFactory, orders: list, another: bool
) -> None:
    ros, messages = Ros(), []
    for n, names in enumerate(orders):
        at = 1.7e9 + 0.05 * n
        values = np.array([{"x": 0.015 * n, "y": -1.0, "z": 7.0}[each] for each in names])
        state = ros("sensor_msgs/JointState", ros.header(at), list(names), values, values, values)
        messages.append((at, "/joints", state))
        if another:
            one = np.zeros(1)
            state = ros("sensor_msgs/JointState", ros.header(at + 0.01), ["w"], one, one, one)
            messages.append((at + 0.01, "/joints", state))
    recording = read_rosbag(ros.bag(tmp_path_factory.mktemp("bag") / "b", messages))
    columns = ['["/joints.position.x", "/joints.position.y"]']
    if another:
        assert "several sets of names" in refused(recording, BODY.format('"/joints.position"'))
    else:
        first = "".join(orders[0])
        columns.append(f'["/joints.position[{first.index("x")}]", "/joints.position.y"]')
    for each in columns:
        np.testing.assert_allclose(
            speeds(imported(recording, BODY.format(each))[0]), 0.3, atol=1e-6
        )


def test_poses_in_lists_and_topics_without_numbers_are_named(tmp_path: Path) -> None:
    ros, messages = Ros(), []
    for n in range(20):
        at = 1.7e9 + 0.05 * n
        poses = ros("geometry_msgs/PoseArray", ros.header(at), [ros.pose(0.015 * n), ros.pose(1)])
        messages += [(at, "/objects", poses), (at, "/note", ros("std_msgs/String", "a"))]
    recording = read_rosbag(ros.bag(tmp_path / "b", messages))
    (one,) = imported(recording, BODY.format('"/objects.poses[0].position[0:2]"'))
    np.testing.assert_allclose(speeds(one), 0.3, atol=1e-6)
    assert recording.episodes[0].others == {"/note": "no numbers"}
    other = BODY.format('"/objects.poses[1].position[0:2]"')
    given_map = parse_map("map", f"dimension = 2\n[time]\ndt = 0.05\n{other}")
    _, (unused, *_) = to_trajectories(read_rosbag(tmp_path / "b"), given_map)
    assert "/objects.poses[0].position" in unused and "/note" in unused


@FEW
@given(
    st.sampled_from([2, 3]),
    arrays(np.float64, 3, elements=finite),
    arrays(np.float64, 3, elements=finite),
    arrays(np.float64, 3, elements=finite),
)
def test_a_pose_in_the_frame_of_a_body_turns_with_it(
    folder: Path, dimension: int, turn: np.ndarray, place: np.ndarray, own: np.ndarray
) -> None:
    axes = "xyz"[:dimension]
    if dimension == 2:
        turn, own, place = turn * [0, 0, 1], own * [0, 0, 1], place * [1, 1, 0]
    hand = Rotation.from_rotvec(np.linspace(0, 1, 9)[:, None] * turn)
    tool = Rotation.from_rotvec(np.tile(own, (9, 1)))
    values = np.column_stack(
        [0.1 * np.arange(9), np.tile(place, (9, 1)), hand.as_quat(), tool.as_quat()]
    )
    recording = table(folder, "time,x,y,z,a,b,c,d,e,f,g,h", values.tolist())
    quaternion = 'orientation = {{ columns = ["{}", "{}", "{}", "{}"], order = "xyzw" }}\n'
    columns = json.dumps(list(axes))
    text = SPACE * (dimension == 3) + BODY.format(columns) + quaternion.format(*"abcd")
    tool_text = BODY.format(columns).replace("box", "tool", 1) + quaternion.format(*"efgh")
    (one,) = imported(recording, text + tool_text + 'in_frame_of = "box"\n', 0.1)
    world = (place + hand.apply(place))[:, :dimension]
    np.testing.assert_allclose(one.position[:, 1], world, atol=1e-9)
    both = hand * tool
    if dimension == 3:
        found = Rotation.from_quat(np.roll(one.orientation[:, 1], -1, axis=1))
        assert (found * both.inv()).magnitude().max() < 1e-6
    else:
        wrong = one.orientation[:, 1, 0] - both.as_rotvec()[:, 2]
        np.testing.assert_allclose((wrong + np.pi) % (2 * np.pi), np.pi, atol=1e-6)


def test_what_was_not_seen_and_what_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        (0.05 * n, 0 if 10 <= n < 13 else 2 + 0.015 * n, 0 if 10 <= n < 13 else 1, 0.5)
        for n in range(30)
    ]
    recording = table(tmp_path, "time,x,y,force", rows)
    (one,) = imported(recording, f"{XY}missing = 0\n")
    np.testing.assert_allclose(speeds(one), 0.3)
    assert one.tracked is not None and one.tracked.sum() < 30
    said = refused(recording, f"{XY}max_speed = 5\n")
    assert "box: max_speed is 5 m/s, found 48.2 m/s at 0.65 s" in said
    (tmp_path / "map.toml").write_text(f"dimension = 2\n[time]\ndt = 0.05\n{XY}")
    command = ["import", "csv", str(tmp_path / "a.csv"), "--map", str(tmp_path / "map.toml")]
    assert run([*command, "--out", str(tmp_path / "a.h5")]) == 0
    printed = capsys.readouterr()
    assert "warning: positions jump: box 2 times, in one step by more than 10 times" in printed.err
    assert (
        "  box: at most 48.2 m/s; largest step 241 cm, to 0.65 s of trajectory 0\n" in printed.out
    )
    assert "  not used: force\n" in printed.out
    assert run(["info", str(tmp_path / "a.h5")]) == 0
    assert "positions jump: box 2 times" in capsys.readouterr().out
