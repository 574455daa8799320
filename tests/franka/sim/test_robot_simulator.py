"""The simulated robot's processes: start, clock, camera and end."""

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

from contactgraph_franka.perception.camera import CameraFrame
from contactgraph_franka.perception.detector import ObjectDetector
from contactgraph_franka.sim.camera import CameraSettings
from contactgraph_franka.sim.session import find_session
from contactgraph_franka.sim.simulated_robot import RobotSimulator, SimulatedRobot, attach

PACE = 2.0
PATIENCE = 20.0
"""s, on the wall, for what should take one."""


@pytest.mark.parametrize("pace", [0.0, np.nan, 1000.0])
def test_an_impossible_pace_is_refused(pace: float) -> None:
    with pytest.raises(InvalidInputError, match="pace must be"):
        RobotSimulator(pace=pace)


@pytest.mark.slow
def test_the_death_of_a_server_is_reported(server_turn: None) -> None:
    simulator = RobotSimulator(pace=PACE)
    with simulator as running:
        simulator.check()
        server = simulator._workers[0].process
        server.kill()
        server.join()
        with pytest.raises(RuntimeError, match=r"the simulated arm ended with exit code -9"):
            simulator.check()
        address = running.address
    with pytest.raises(InvalidInputError, match="no simulated robot runs"):
        find_session(address)


@pytest.mark.slow
def test_no_process_outlives_its_owner(server_turn: None) -> None:
    script = (
        "import time\nfrom contactgraph_franka.sim.simulated_robot import RobotSimulator\n"
        "r = RobotSimulator(pace=2.0)\nwith r as running:\n"
        "    print(r._workers[0].process.pid, flush=True)\n    time.sleep(60)\n"
    )
    owner = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    server = int(owner.stdout.readline())
    os.kill(owner.pid, signal.SIGKILL)
    owner.wait()
    owner.stdout.close()
    until = time.monotonic() + PATIENCE
    while _alive(server):
        assert time.monotonic() < until, "the server is still there"
        time.sleep(0.05)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_frames_are_delayed_and_show_the_block_at_their_time(server_turn: None) -> None:
    settings = CameraSettings(delay=0.03)
    try:
        with RobotSimulator(pace=5.0, camera=settings) as running:
            check_frames(running, settings)
    except InvalidInputError as error:
        if "OpenGL" in str(error):
            pytest.skip(str(error))
        raise


def check_frames(running: SimulatedRobot, settings: CameraSettings) -> None:
    frames = filmed(running, 3)
    for frame, now in frames[1:]:
        assert now - frame.time >= settings.delay
    last = frames[-1][0]
    calibration = running.calibration()
    observed = ObjectDetector(calibration).detect(last)["block"]
    there = running.ground_truth.between(last.time - 1e-6, last.time + 1e-6)
    assert len(there) == 1
    error = observed.position - there[0]["position"][1]
    assert np.linalg.norm(error) < 3e-3
    mistaken = running.calibration(shift=[0.01, 0.0, 0.0], turn=[0.0, 0.0, 0.02])
    off = mistaken.camera_pose[:3, 3] - calibration.camera_pose[:3, 3]
    np.testing.assert_allclose(off, [0.01, 0.0, 0.0])
    turned = mistaken.camera_pose[:3, 2] - calibration.camera_pose[:3, 2]
    level = np.linalg.norm(calibration.camera_pose[:2, 2])
    assert np.linalg.norm(turned[:2]) == pytest.approx(0.02 * level, rel=0.02)


def filmed(running: SimulatedRobot, count: int) -> list[tuple[CameraFrame, float]]:
    """Frames, and when each was had."""
    camera = attach(running.address).camera()
    frames: list[tuple[CameraFrame, float]] = []
    until = time.monotonic() + PATIENCE
    while len(frames) < count:
        frame = camera.read()
        if frame is not None:
            frames.append((frame, running.clock()))
        assert time.monotonic() < until, "the camera sends nothing"
        time.sleep(0.005)
    return frames


@pytest.fixture(scope="module")
def running(server_turn: None) -> Iterator[SimulatedRobot]:
    with RobotSimulator(pace=PACE) as running:
        yield running


@pytest.mark.slow
def test_the_simulation_keeps_to_the_clock(running: SimulatedRobot) -> None:
    first = running.ground_truth.newest()
    time.sleep(0.5)
    rows = running.ground_truth.since(int(first["number"]))
    assert np.array_equal(np.diff(rows["number"]), np.ones(len(rows) - 1))
    assert running.clock() - rows["stamp"][-1] < 0.02
    # Simulated seconds and those of the clock are as long; a busy machine may drop a few cycles.
    span = rows[-1]["stamp"] - rows[0]["stamp"]
    assert rows[-1]["time"] - rows[0]["time"] == pytest.approx(span, rel=0.1)
    assert running.rate > 250 / PACE


@pytest.mark.slow
@pytest.mark.parametrize(
    ("index", "position", "words"),
    [
        (1, [0.5, 0.0, 0.05], "block must be 0 to 0, found 1"),
        (0, [0.5, 0.0, np.nan], r"position must be \[3\] m"),
        (0, [0.5, 0.0], r"position must be \[3\] m"),
    ],
)
def test_impossible_positions_are_refused(
    running: SimulatedRobot, index: int, position: list[float], words: str
) -> None:
    with pytest.raises(InvalidInputError, match=words):
        running.place_block(index, np.array(position))


@pytest.mark.slow
def test_an_occupied_address_is_refused(running: SimulatedRobot) -> None:
    with (
        pytest.raises(InvalidInputError, match="are not free at"),
        RobotSimulator(addresses=[running.address]),
    ):
        pass
    with pytest.raises(InvalidInputError, match="has no camera"):
        running.camera()
