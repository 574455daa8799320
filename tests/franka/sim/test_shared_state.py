"""Ground truth and frames in shared memory: readers get the newest complete record."""

from pathlib import Path

import numpy as np
import pytest

from contactgraph_franka.perception.camera import CameraFrame, Intrinsics
from contactgraph_franka.sim import shared_state as module
from contactgraph_franka.sim.camera import FrameWriter, SimulatedCamera
from contactgraph_franka.sim.shared_state import (
    GroundTruth,
    GroundTruthWriter,
    SceneResetService,
    request_block_pose,
)

LENS = Intrinsics(20.0, 20.0, 7.5, 7.5, 16, 16)


def written(folder: Path, ticks: int) -> tuple[GroundTruthWriter, GroundTruth]:
    writer = GroundTruthWriter(folder, blocks=1, places=3)
    for tick in range(ticks):
        writer.row["position"] = writer.row["stamp"] = tick
        writer.publish(tick)
    return writer, GroundTruth(folder, blocks=1, places=3)


def test_ticks_are_read_in_order_from_any(tmp_path: Path) -> None:
    _, truth = written(tmp_path, 10)
    assert truth.newest()["tick"] == 9
    assert truth.since(6)["tick"].tolist() == [7, 8, 9]
    assert truth.between(2.5, 5.0)["position"][:, 0, 0].tolist() == [3.0, 4.0, 5.0]


def test_old_ticks_give_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_KEPT", 16)
    monkeypatch.setattr(module, "_MARGIN", 4)
    _, truth = written(tmp_path, 50)
    assert truth.since(-1)["tick"].tolist() == list(range(38, 50))


def test_a_tick_that_is_being_written_is_left_out(tmp_path: Path) -> None:
    writer, truth = written(tmp_path, 10)
    writer._rows["again"][8] = 3
    assert truth.since(5)["tick"].tolist() == [6, 7, 9]


def test_a_camera_gives_each_frame_once_and_the_newest(tmp_path: Path) -> None:
    writer = FrameWriter(tmp_path, LENS, depth=True)
    camera = SimulatedCamera(tmp_path, LENS, depth=True)
    assert camera.read() is None
    for number in range(7):
        image = np.full((16, 16), number, np.uint8)
        writer.publish(CameraFrame(image, image.astype(np.float32) / 2.0, time=0.1 * number))
    writer.miss(2)
    frame = camera.read()
    assert frame is not None and frame.depth is not None
    assert (frame.time, frame.image[3, 4], frame.depth[3, 4]) == (0.1 * 6, 6, 3.0)
    assert camera.read() is None and camera.missed == 2


def test_orders_are_carried_out_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taker = SceneResetService(tmp_path)
    done: list[tuple[int, list[float], float]] = []

    def serve(_: float) -> None:
        taker.execute(lambda block, place, yaw: done.append((block, place.tolist(), yaw)))

    monkeypatch.setattr("contactgraph_franka.sim.shared_state.time.sleep", serve)
    request_block_pose(tmp_path, 0, np.array([0.5, 0.1, 0.05]), 0.2)
    request_block_pose(tmp_path, 1, np.array([0.6, 0.0, 0.05]), 0.0)
    serve(0.0)
    assert done == [(0, [0.5, 0.1, 0.05], 0.2), (1, [0.6, 0.0, 0.05], 0.0)]


def test_a_deaf_server_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    SceneResetService(tmp_path)
    monkeypatch.setattr("contactgraph_franka.sim.shared_state._TIMEOUT", 0.01)
    with pytest.raises(RuntimeError, match="did not put the block"):
        request_block_pose(tmp_path, 0, np.zeros(3), 0.0)
