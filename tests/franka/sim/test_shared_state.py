"""Ground truth and frames in shared memory: readers get the newest complete record."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from contactgraph_franka import shared_ring
from contactgraph_franka.perception.camera import CameraFrame, Intrinsics
from contactgraph_franka.shared_ring import RingReader, RingWriter
from contactgraph_franka.sim import shared_state
from contactgraph_franka.sim.camera import SimulatedCamera, frame_ring, publish_frame
from contactgraph_franka.sim.shared_state import (
    GroundTruth,
    SceneResetService,
    create_ground_truth,
    request_block_pose,
)

LENS = Intrinsics(20.0, 20.0, 7.5, 7.5, 16, 16)


def written(folder: Path, steps: int) -> tuple[RingWriter, GroundTruth]:
    writer = create_ground_truth(folder, blocks=1, nq=3)
    for number in range(steps):
        row = writer.begin()
        row["position"] = row["stamp"] = number
        writer.publish()
    return writer, GroundTruth(folder)


def test_steps_are_read_in_order(tmp_path: Path) -> None:
    _, truth = written(tmp_path, 10)
    assert truth.newest()["number"] == 9 and truth.rate == 1.0
    assert truth.since(6)["number"].tolist() == [7, 8, 9]
    assert truth.between(2.5, 5.0)["position"][:, 0, 0].tolist() == [3.0, 4.0, 5.0]


def test_old_steps_are_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_state, "_KEPT", 16)
    monkeypatch.setattr(shared_ring, "MARGIN", 4)
    _, truth = written(tmp_path, 50)
    assert truth.since(-1)["number"].tolist() == list(range(38, 50))


def test_a_step_that_is_being_written_is_left_out(tmp_path: Path) -> None:
    writer, truth = written(tmp_path, 10)
    writer._slots["again"][8] = 3
    assert truth.since(5)["number"].tolist() == [6, 7, 9]


def test_the_newest_record_is_returned_only_when_complete(tmp_path: Path) -> None:
    fields: list[tuple] = [("value", "f8")]
    writer = RingWriter(tmp_path / "ring", fields, slots=1)
    reader = RingReader(tmp_path / "ring")
    writer.begin()["value"] = 1.0
    writer.publish()
    writer.begin()["value"] = 2.0
    with ThreadPoolExecutor(1) as threads:
        record = threads.submit(reader.newest)
        time.sleep(0.02)
        assert not record.done()
        writer.publish()
        assert record.result()["value"] == 2.0 and reader.count == 2


def test_a_camera_gives_each_frame_once_and_the_newest(tmp_path: Path) -> None:
    ring = frame_ring(tmp_path, LENS)
    camera = SimulatedCamera(tmp_path, LENS)
    assert camera.read() is None
    for number in range(7):
        image = np.full((16, 16), number, np.uint8)
        publish_frame(ring, CameraFrame(image, None, time=0.1 * number))
    frame = camera.read()
    assert frame is not None
    assert (frame.time, frame.image[3, 4], frame.depth) == (0.1 * 6, 6, None)
    assert camera.read() is None


def test_resets_are_executed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taker = SceneResetService(tmp_path)
    done: list[tuple[int, list[float], float]] = []

    def serve(_: float) -> None:
        taker.execute(lambda block, place, yaw: done.append((block, place.tolist(), yaw)))

    monkeypatch.setattr("contactgraph_franka.sim.shared_state.time.sleep", serve)
    request_block_pose(tmp_path, 0, np.array([0.5, 0.1, 0.05]), 0.2)
    request_block_pose(tmp_path, 1, np.array([0.6, 0.0, 0.05]), 0.0)
    serve(0.0)
    assert done == [(0, [0.5, 0.1, 0.05], 0.2), (1, [0.6, 0.0, 0.05], 0.0)]


def test_a_silent_server_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    SceneResetService(tmp_path)
    monkeypatch.setattr("contactgraph_franka.sim.shared_state._TIMEOUT", 0.01)
    with pytest.raises(RuntimeError, match="did not put the block"):
        request_block_pose(tmp_path, 0, np.zeros(3), 0.0)
