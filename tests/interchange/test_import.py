"""Recordings of each format become the trajectories that their maps say."""

from pathlib import Path

import numpy as np
import pytest
from recordings import (
    FETCH_STEPS,
    RATE,
    lerobot_folder,
    mcap_file,
    minari_folder,
    motive_file,
    turning_t,
)
from scipy.spatial.transform import Rotation

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.interchange import read_map, shipped_maps, to_trajectories
from contactgraph.interchange.csv_table import read_csv
from contactgraph.interchange.draft import draft_map
from contactgraph.interchange.lerobot import read_lerobot
from contactgraph.interchange.minari import read_minari
from contactgraph.interchange.recording import Recording
from contactgraph.interchange.rosbag import read_rosbag
from contactgraph.interchange.scene_map import parse_map

PLANE = """
dimension = 2
[time]
dt = 0.1
[[body]]
name = "hand"
position = ["x", "y"]
"""


def imported(recording: Recording, text: str) -> list[Trajectory]:
    return list(to_trajectories(recording, parse_map("map", text))[0])


def table(path: Path, text: str) -> Recording:
    path.write_text(text)
    return read_csv(path)


def test_fetch_push_by_the_shipped_map(tmp_path: Path) -> None:
    recording = read_minari(minari_folder(tmp_path / "fetch"))
    first = recording.episodes[0]
    assert recording.environment == "FetchPush-v4"
    assert first.others == {"infos/text": "text of variable length in shape (12,)"}
    (one, *_), notes = to_trajectories(recording, read_map("fetch-push"))
    assert not any("resampled" in note for note in notes)
    raw = first.columns["observations/observation"].values
    np.testing.assert_array_equal(one.position[:, 0], raw[:, :3])
    np.testing.assert_array_equal(one.position[:, 1], raw[:, 3:6])
    np.testing.assert_allclose(
        one.velocity[1:], np.diff(one.position, axis=0) / 0.04, err_msg="backward differences"
    )
    turned = Rotation.from_quat(np.roll(one.orientation[:, 1], -1, axis=1))
    expected = Rotation.from_euler("XYZ", raw[:, 11:14])
    assert (turned * expected.inv()).magnitude().max() < 1e-9
    actions = first.columns["actions"].values
    np.testing.assert_allclose(one.control, 0.05 * actions[:, :3])
    assert one.steps == FETCH_STEPS
    assert one.scene.control_kind == ("displacement",) * 3
    np.testing.assert_array_equal(one.scene.goal, [1.3, 0.7, 0.42])
    assert one.tracked is None


def test_corners_of_the_t_tell_its_pose(tmp_path: Path) -> None:
    recording = read_lerobot(lerobot_folder(tmp_path / "pusht"))
    assert recording.dt == pytest.approx(0.1)
    assert recording.episodes[0].others == {"observation.image": "video of shape [3, 96, 96]"}
    one = to_trajectories(recording, read_map("pusht"))[0][0]
    agent, _, pose, action = turning_t()
    np.testing.assert_allclose(one.position[:, 0], 1e-3 * agent, atol=1e-7)
    sine, cosine = np.sin(pose[:, 2]), np.cos(pose[:, 2])
    centre = pose[:, :2] + 45.0 * np.stack([-sine, cosine], axis=1)
    np.testing.assert_allclose(one.position[:, 1], 1e-3 * centre, atol=1e-7)
    np.testing.assert_allclose(one.orientation[:, 1, 0], pose[:, 2], atol=1e-6)
    np.testing.assert_allclose(one.angular_velocity[1:, 1, 0], 4.0, atol=1e-4)
    np.testing.assert_allclose(one.control, 1e-3 * action[:-1], atol=1e-7)


def test_a_take_of_motive_in_the_plane(tmp_path: Path) -> None:
    text = """
    dimension = 2
    [[body]]
    name = "hand"
    position = { columns = ["Hand.position[0]", "Hand.position[2]"], scale = [1, -1] }
    [[body]]
    name = "block"
    position = { columns = ["Block.position[0]", "Block.position[2]"], scale = [1, -1] }
    orientation = { columns = "Block.rotation", order = "xyzw", axis = "y" }
    """
    units = [read_csv(motive_file(tmp_path / "take.csv", u)) for u in ("Millimeters", "Meters")]
    (one,), (same,) = (imported(each, text) for each in units)
    np.testing.assert_allclose(one.position, same.position, atol=1e-6)
    assert one.scene.dt == 1.0 / RATE
    time = one.scene.dt * np.arange(one.steps + 1)
    np.testing.assert_allclose(one.position[:, 0], np.stack([time, 0 * time + 0.2], 1), atol=1e-5)
    hidden = slice(20, 26)
    seen = np.ones(len(time), dtype=bool)
    seen[hidden] = False
    np.testing.assert_allclose(one.position[seen, 1, 0], 0.3 + time[seen] ** 2, atol=1e-6)
    np.testing.assert_allclose(one.orientation[:, 1, 0], 0.3 + time, atol=1e-5)
    assert one.tracked[:, 0].all()
    np.testing.assert_array_equal(one.tracked[:, 1], seen | (np.arange(len(time)) == 20))
    np.testing.assert_allclose(one.measured_at[hidden, 1], 19 / RATE, atol=1e-6)
    np.testing.assert_allclose(one.measured_at[:, 0], time, atol=1e-5)


def test_topics_of_a_bag_are_resampled(tmp_path: Path) -> None:
    recording = read_rosbag(mcap_file(tmp_path / "bag.mcap"))
    text = """
    dimension = 3
    [time]
    dt = 0.05
    [[body]]
    name = "hand"
    actuated = true
    position = "/hand/pose.pose.position"
    [[body]]
    name = "block"
    position = "/block/pose.pose.position"
    orientation = { columns = "/block/pose.pose.orientation", order = "xyzw" }
    [[control]]
    columns = "/force.wrench.force"
    kind = "force"
    body = "hand"
    """
    (one,) = imported(recording, text)
    time = one.position[:, 0, 0] / 0.1
    np.testing.assert_allclose(np.diff(time), 0.05, atol=1e-6)
    np.testing.assert_allclose(one.position[:, 0, 1], np.sin(time), atol=2e-4)
    np.testing.assert_allclose(one.position[:, 1, 0], 0.5 + 0.1 * time, atol=1e-6)
    angle = 2 * np.arctan2(one.orientation[:, 1, 3], one.orientation[:, 1, 0])
    np.testing.assert_allclose(angle, time, atol=1e-6)
    assert one.tracked.all()
    held = np.sin(3 * np.floor(20 * time[:-1] + 1e-9) / 20)
    following = np.sin(3 * np.floor(20 * time[1:] + 1e-9) / 20)
    share = (20 * time[:-1]) % 1
    np.testing.assert_allclose(one.control[:, 0], (1 - share) * held + share * following, atol=1e-4)
    assert (np.abs(one.measured_at - (time - time[0])[:, None]) < 0.05).all()


def test_a_long_gap_ends_a_trajectory(tmp_path: Path) -> None:
    times = [*np.arange(0, 1, 0.1), *np.arange(3, 4, 0.1)]
    rows = "\n".join(f"{t:.3f},{t},0" for t in times)
    recording = table(tmp_path / "gap.csv", f"time,x,y\n{rows}\n")
    text = PLANE.replace("actuated = true", "")
    found, notes = to_trajectories(recording, parse_map("map", text))
    assert [each.steps for each in found] == [9, 9]
    assert notes[0].startswith("1 episodes with gaps or uneven stamps were resampled")
    np.testing.assert_allclose(found[1].position[0, 0], [3.0, 0.0])
    whole = imported(recording, text.replace("[time]", "[time]\nmax_gap = 5"))
    assert [each.steps for each in whole] == [39]
    assert whole[0].tracked.sum() == 21


def test_a_trajectory_ends_where_a_body_leaves_its_bounds(tmp_path: Path) -> None:
    rows = "".join(f"{t / 10},{t},0\n" for t in range(8))
    recording = table(tmp_path / "fall.csv", f"time,x,y\n{rows}")
    bounds = '"x", "y"]\nbounds = [[0, -1], [4.5, 1]]'
    text = PLANE.replace("actuated = true", "").replace('"x", "y"]', bounds)
    found, notes = to_trajectories(recording, parse_map("map", text))
    (one,) = found
    np.testing.assert_array_equal(one.position[:, 0, 0], np.arange(5.0))
    assert (one.steps, len(one.control)) == (4, 4)
    assert "1 end, or are left out, where a body leaves its bounds" in notes


def test_scale_offset_relative_reference_and_stored_velocity(tmp_path: Path) -> None:
    text = """
    dimension = 2
    goal = "gx,gy"
    [time]
    dt = 0.1
    [[body]]
    name = "hand"
    actuated = true
    position = { columns = ["x", "y"], scale = 0.001, offset = [1, 2] }
    velocity = { columns = ["vx", "vy"], scale = 0.001 }
    [[body]]
    name = "tool"
    position = ["dx", "dy"]
    relative_to = "hand"
    orientation = { columns = "deg", scale = 0.017453292519943295 }
    reference = [1.0, 0.0]
    velocity = ["dx", "dy"]
    [[control]]
    columns = "f"
    kind = "velocity"
    body = "hand"
    scale = 2
    """.replace('"gx,gy"', "[5, 6]")
    names = "x,y,vx,vy,dx,dy,deg,f"
    recording = table(tmp_path / "a.csv", f"{names}\n0,0,9,8,0.5,0,90,1\n100,0,9,8,0.5,0,90,\n")
    (one,) = imported(recording, text)
    np.testing.assert_allclose(one.position[:, 0], [[1, 2], [1.1, 2]])
    np.testing.assert_allclose(one.velocity[:, 0], [[0.009, 0.008]] * 2)
    np.testing.assert_allclose(one.position[:, 1], [[1.5, 3], [1.6, 3]])
    np.testing.assert_allclose(one.velocity[:, 1], [[0.509, 0.008]] * 2)
    np.testing.assert_allclose(one.control, [[2.0]])
    assert np.isnan(one.orientation[:, 0]).all()
    np.testing.assert_array_equal(one.scene.goal, [5, 6])
    np.testing.assert_array_equal(one.scene.control_of, [[True], [False]])


def test_one_file_holds_several_episodes(tmp_path: Path) -> None:
    text = "episode;t;x;y\n" + "".join(
        f"{e};{0.1 * t:.1f};{t};{e}\n" for e in (7, 3) for t in range(4)
    )
    found = imported(table(tmp_path / "two.csv", text), PLANE.replace("actuated = true", ""))
    assert [each.position[0, 0, 1] for each in found] == [7.0, 3.0]


@pytest.mark.parametrize("name", shipped_maps())
def test_shipped_maps_are_valid(name: str) -> None:
    assert read_map(name).bodies


def test_drafts_can_be_read(tmp_path: Path) -> None:
    recordings = (
        read_csv(motive_file(tmp_path / "take.csv")),
        read_rosbag(mcap_file(tmp_path / "bag.mcap")),
        read_lerobot(lerobot_folder(tmp_path / "pusht")),
        table(
            tmp_path / "plain.csv",
            "time,hand.x,hand.y,box_x,box_y,action\n0,1,2,3,4,5\n1,1,2,3,4,5\n",
        ),
    )
    names = (["Hand", "Block"], ["/hand/pose", "/block/pose"], ["body"], ["hand", "box"])
    for recording, expected in zip(recordings, names, strict=True):
        text = draft_map(recording)
        assert [body.name for body in parse_map("draft", text).bodies] == expected
        assert imported(recording, text)
    minari = draft_map(read_minari(minari_folder(tmp_path / "fetch")))
    assert "--map fetch-push" in minari
    assert parse_map("draft", minari).environment == "FetchPush-"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[time]", "[tiem]"), "map: no key 'tiem'; valid keys are dimension, goal, time"),
        (('"x", "y"', '"x", "z"'), "body[0]: position: no column 'z'; there are time[1], x[1]"),
        (('"x", "y"', '"x"'), "body[0]: position must have 2 numbers, found 1"),
        (('"x", "y"', '"x[0:2]"'), "'x[0:2]' must lie in x[0:1]"),
        (('"x", "y"', '"x", "note"'), "column 'note' must be numbers, found 'a' in row 1"),
        (("dimension = 2", "dimension = 5"), "dimension must be 2 or 3"),
        (("dt = 0.1", "dt = 0"), "map: time: dt must be above 0, found 0.0"),
        (("dt = 0.1", "dt = 'a'"), "map: time: field 'dt' must be a finite number, found 'a'"),
        (("dt = 0.1", ""), "the time of a step must be given, [time] dt = s"),
        (('name = "hand"', 'name = "hand"\nmass = [1]'), "mass must have shape (), found (1,)"),
        (('name = "hand"', 'name = "hand"\nrelative_to = "table"'), "relative_to must name a body"),
        (('name = "hand"', 'name = "hand"\nreference = [0, 0]'), "reference needs an orientation"),
        (
            ('["x", "y"]', '["x", "y"]\norientation = { columns = "x", order = "zyx" }'),
            "order must",
        ),
        (('["x", "y"]', '["x", "y"]\n[[control]]\ncolumns = "x"\nkind = "push"'), "control_kind"),
        (
            ('["x", "y"]', '["x", "y"]\n[[control]]\ncolumns = "x"\nkind = "force"\nbody = "a"'),
            "control[0]: body must name a body with actuated = true, found 'a'",
        ),
        (('["x", "y"]', '["x", "y"]\n[[contact]]\ncolumns = "x"\nbodies = ["hand"]'), "name two"),
        (('position = ["x", "y"]', ""), "must have either position or keypoints"),
        (("dimension = 2", "dimension = = 2"), "map: must be TOML"),
    ],
)
def test_faults_of_a_map(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    recording = table(tmp_path / "a.csv", "time,x,y,note\n0,1,2,a\n0.1,1,2,b\n")
    with pytest.raises(InvalidInputError) as caught:
        imported(recording, PLANE.replace(*change))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("x,x\n1,2\n", "must begin with a line of different names, found ['x', 'x']"),
        ("x,y\n", "must have rows of numbers, found none"),
        ("x,y\n1,2\n3\n", "row 2 must have 2 fields, found 1"),
        ("x,y\n1,2\n3,4,5\n", "row 2 must have 2 fields, found 3"),
        ("time,x,y\n0,1,2\n0,1,2\n", "times must be finite and increase, found [0.0, 0.0] s"),
        (
            "time,x,y\n0,1,2\n,1,2\n",
            "times must be finite and increase, found [nan] s from row 2 on",
        ),
        ("time,x,y\n0,1,2\n1e300,1,2\n", "rows are 1e+300 s apart, but max_gap is 0.5 s"),
        ("x,y\n,\n", "must have rows of numbers"),
        ("x,y\nnan,1\n", "must have numbers, found none"),
        ("x,y\n1,2\n", "no step of dt = 0.1 s in which all is known"),
        ("Format Version,1.23\n\n", "must have a line of axes that begins with Frame"),
        ("Format Version,1.23,Length Units,Feet\n", "Length Units must be Meters or"),
        ("Format Version,1.23\n\nFrame,Time,X\n0,0,1\n", "must have lines of Name and of"),
    ],
)
def test_faults_of_a_table(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError) as caught:
        imported(table(tmp_path / "a.csv", text), PLANE)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_shipped_map_counts_beside_a_folder_of_its_name(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "pusht").mkdir()
    monkeypatch.chdir(tmp_path)
    assert read_map("pusht").dimension == 2
