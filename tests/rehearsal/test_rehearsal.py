"""The server's processes, and the real client against them."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from contactgraph.data import InvalidInputError

pytest.importorskip("franky_sim", reason="needs pip install 'contactgraph[rehearsal]'")

from contactgraph.rehearsal.camera_settings import CameraSettings
from contactgraph.rehearsal.rehearsal import Rehearsal, RunningRehearsal, attach
from contactgraph.rehearsal.session import attached
from contactgraph.robot.perception.object_pose import object_pose
from contactgraph.robot.perception.tags import TagDetector

PACE = 2.0


@pytest.fixture(scope="module")
def running(server_turn: None) -> Iterator[RunningRehearsal]:
    with Rehearsal(pace=PACE) as running:
        yield running


def test_the_simulation_keeps_to_the_readers_clock(running: RunningRehearsal) -> None:
    first = running.truth.newest()
    time.sleep(0.5)
    rows = running.truth.since(int(first["tick"]))
    assert np.array_equal(np.diff(rows["tick"]), np.ones(len(rows) - 1))
    assert running.clock() - rows["stamp"][-1] < 0.02
    # Simulated seconds and those of the clock are as long; a busy machine may drop a few ticks.
    span = rows[-1]["stamp"] - rows[0]["stamp"]
    assert rows[-1]["time"] - rows[0]["time"] == pytest.approx(span, rel=0.1)
    assert running.report().ticks > 250


def test_the_client_sees_the_arm_where_it_is(running: RunningRehearsal) -> None:
    franky = pytest.importorskip("franky", reason="needs pip install 'contactgraph[robot]'")
    for attempt in range(3):
        try:
            arm = franky.Robot(running.address, realtime_config=franky.RealtimeConfig.Ignore)
            state = arm.state
            break
        except franky.NetworkException:
            if attempt == 2:
                raise
    truth = running.truth.newest()
    np.testing.assert_allclose(state.q, truth["places"][:7], atol=1e-5)
    # Its own point of the hand is 22 mm above the grasp point.
    np.testing.assert_allclose(
        state.O_T_EE.translation - [0.0, 0.0, 0.022], truth["position"][0], atol=1e-4
    )
    assert state.m_ee == pytest.approx(0.76)


def test_a_block_is_put_where_asked_from_any_process(running: RunningRehearsal) -> None:
    attach(running.address).place_block(0, np.array([0.6, 0.1, 0.05]), 0.4)
    time.sleep(0.1)
    row = running.truth.newest()
    np.testing.assert_allclose(row["position"][1], [0.6, 0.1, 0.05], atol=1e-3)
    assert row["turn"][1][3] == pytest.approx(np.sin(0.2), abs=1e-3)


@pytest.mark.parametrize(
    ("index", "position", "words"),
    [
        (1, [0.5, 0.0, 0.05], "block must be 0 to 0, found 1"),
        (0, [0.5, 0.0, np.nan], r"position must be \[3\] m"),
        (0, [0.5, 0.0], r"position must be \[3\] m"),
    ],
)
def test_impossible_places_are_refused(
    running: RunningRehearsal, index: int, position: list[float], words: str
) -> None:
    with pytest.raises(InvalidInputError, match=words):
        running.place_block(index, np.array(position))


def test_a_taken_address_is_told(running: RunningRehearsal) -> None:
    with (
        pytest.raises(InvalidInputError, match="are not free at"),
        Rehearsal(addresses=[running.address]),
    ):
        pass
    with pytest.raises(InvalidInputError, match="has no camera"):
        running.camera()


@pytest.mark.parametrize("pace", [0.0, np.nan, 1000.0])
def test_an_impossible_pace_is_refused(pace: float) -> None:
    with pytest.raises(InvalidInputError, match="pace must be"):
        Rehearsal(pace=pace)


def test_a_server_that_dies_is_told(server_turn: None) -> None:
    rehearsal = Rehearsal(pace=PACE)
    with rehearsal as running:
        rehearsal.check()
        server = rehearsal._children[0]._process
        server.kill()
        server.wait()
        with pytest.raises(RuntimeError, match=r"arm_server ended with code -9"):
            rehearsal.check()
        address = running.address
    with pytest.raises(InvalidInputError, match="no rehearsal runs"):
        attached(address)


def test_nothing_outlives_its_owner(server_turn: None) -> None:
    script = (
        "import time\nfrom contactgraph.rehearsal.rehearsal import Rehearsal\n"
        "r = Rehearsal(pace=2.0)\nwith r as running:\n"
        "    print(r._children[0]._process.pid, flush=True)\n    time.sleep(60)\n"
    )
    owner = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    server = int(owner.stdout.readline())
    os.kill(owner.pid, signal.SIGKILL)
    owner.wait()
    owner.stdout.close()
    until = time.monotonic() + 5.0
    while _alive(server):
        assert time.monotonic() < until, "the server is still there"
        time.sleep(0.05)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_frames_come_late_and_show_the_block_where_it_was(server_turn: None) -> None:
    settings = CameraSettings(delay=0.03)
    try:
        rehearsal = Rehearsal(pace=5.0, camera=settings)
        running = rehearsal.__enter__()
    except InvalidInputError as error:
        if "OpenGL" in str(error):
            pytest.skip(str(error))
        raise
    with rehearsal:
        camera = attach(running.address).camera()
        frames = []
        while len(frames) < 3:
            frame = camera.read()
            if frame is not None:
                frames.append((frame, running.clock()))
            time.sleep(0.005)
        for frame, now in frames[1:]:
            assert now - frame.time >= settings.delay
        calibration = running.calibration()
        tagged = calibration.objects["block"]
        seen = TagDetector([list(tagged.by_id)]).detect(frames[-1][0].image)
        pose = object_pose(seen, tagged, camera.intrinsics)
        assert pose is not None
        there = running.truth.between(frames[-1][0].time - 1e-6, frames[-1][0].time + 1e-6)
        assert len(there) == 1
        error = (calibration.camera_pose @ pose.pose)[:3, 3] - there[0]["position"][1]
        assert np.linalg.norm(error) < 3e-3
        mistaken = running.calibration(shift=[0.01, 0.0, 0.0], turn=[0.0, 0.0, 0.02])
        off = mistaken.camera_pose[:3, 3] - calibration.camera_pose[:3, 3]
        np.testing.assert_allclose(off, [0.01, 0.0, 0.0])
        turned = mistaken.camera_pose[:3, 2] - calibration.camera_pose[:3, 2]
        assert np.linalg.norm(turned[:2]) == pytest.approx(0.02 * 0.894, rel=0.02)
