import dataclasses
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from synthetic_pickup import changed
from test_report_page import bare

from contactgraph.data import InvalidInputError
from contactgraph.viz import write_animation, write_summary_figure
from contactgraph.viz.animation import frame_states
from contactgraph.viz.summary_figure import summary_states

GRIPPER = np.array([0x1B, 0x66, 0xA8])


def shortened(scene, steps, dt=0.05):
    """The steps around the start of ``scene`` alone."""
    recorded, steps_of = (
        scene.trajectory,
        ("belief", "inverse_mass", "stiffness", "damping", "plan"),
    )
    cut = {name: getattr(scene, name)[:steps] for name in steps_of}
    states = ("position", "velocity", "contact")
    cut |= {name: getattr(recorded, name)[: steps + 1] for name in states}
    return changed(scene, dt=dt, control=recorded.control[:steps], **cut)


@pytest.mark.parametrize(("dt", "states"), [(0.05, range(9)), (0.01, [0, 4, 8])])
def test_a_gif_has_a_frame_for_every_state_or_as_many_as_are_seen(tmp_path, scene, dt, states):
    path, shown = tmp_path / "new" / "scene.gif", shortened(scene, 8, dt)
    assert list(frame_states(shown)) == list(states)
    write_animation(path, shown)
    with Image.open(path) as picture:
        assert picture.n_frames == len(states)
        assert picture.info["duration"] == (40 if dt == 0.01 else 50)
        assert picture.info["loop"] == 0
    assert [one.name for one in path.parent.iterdir()] == ["scene.gif"]


def test_gripper_moves_in_the_picture(tmp_path, scene):
    path = tmp_path / "scene.gif"
    write_animation(path, dataclasses.replace(shortened(scene, 12), plan=None))
    places = []
    with Image.open(path) as picture:
        for frame in (0, 12):
            picture.seek(frame)
            pixels = np.asarray(picture.convert("RGB")).astype(int)
            ring = np.abs(pixels - GRIPPER).sum(axis=-1) < 30
            assert ring.sum() > 50
            places.append(np.argwhere(ring).max(axis=0)[1])
    assert places[1] > places[0] + 20


def test_other_endings_and_missing_ffmpeg_are_the_users_to_mend(tmp_path, scene, monkeypatch):
    with pytest.raises(InvalidInputError, match=r"must end in \.gif or \.mp4, found '\.avi'"):
        write_animation(tmp_path / "scene.avi", scene)
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InvalidInputError, match=r"pip install imageio-ffmpeg, or name a \.gif"):
        write_animation(tmp_path / "scene.mp4", scene)
    assert list(tmp_path.iterdir()) == []


def test_mp4_hands_every_frame_to_ffmpeg(tmp_path, scene, monkeypatch):
    drawn = {}

    def ffmpeg(command, input, **settings):
        drawn.update(command=command, size=len(input))
        Path(command[-1]).write_bytes(b"film")
        return subprocess.CompletedProcess(command, 0, b"", b"")

    monkeypatch.setattr("shutil.which", lambda name: "/bin/ffmpeg")
    monkeypatch.setattr("subprocess.run", ffmpeg)
    write_animation(tmp_path / "scene.mp4", shortened(scene, 4))
    width, height = map(int, drawn["command"][drawn["command"].index("-s") + 1].split("x"))
    assert drawn["size"] == 5 * width * height * 3
    assert drawn["command"][drawn["command"].index("-r") + 1] == "20"
    assert (tmp_path / "scene.mp4").read_bytes() == b"film"


def test_still_is_a_picture_with_the_grasp_in_the_middle(tmp_path, scene):
    path = tmp_path / "still.png"
    write_summary_figure(path, scene)
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    assert pixels.shape[1] > 1200
    assert (np.abs(pixels - GRIPPER).sum(axis=-1) < 30).sum() > 500
    assert summary_states(scene)[2] == int(np.argmax(scene.contact[:, 0]))


@pytest.mark.parametrize("nodes", [1, 2])
def test_still_and_film_of_a_trajectory_without_contacts_or_parameters(tmp_path, scene, nodes):
    write_summary_figure(tmp_path / "still.png", bare(scene, nodes))
    named = dataclasses.replace(bare(scene, nodes), name="costs $5_x^ and $")
    write_animation(tmp_path / "scene.gif", changed(named, dt=0.0008))
    assert (tmp_path / "scene.gif").stat().st_size > 1000
