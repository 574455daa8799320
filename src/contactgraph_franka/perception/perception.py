"""Object detection in a process of its own, and its measurements in shared memory."""

import math
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop.worker_process import WorkerProcess
from contactgraph_franka.perception.calibration import CameraCalibration
from contactgraph_franka.perception.camera import Camera, Intrinsics
from contactgraph_franka.perception.detector import ObjectDetector
from contactgraph_franka.perception.tracker import PositionMeasurement
from contactgraph_franka.shared_ring import MARGIN, MEMORY, RingReader, RingWriter

_FIELDS: list[tuple] = [("time", "f8"), ("position", "f8", (3,)), ("covariance", "f8", (3, 3))]
_RETURNED = 5
"""Measurements of an object that are returned at most."""
_SLOTS = _RETURNED + MARGIN
_PAUSE = 0.001  # s between polls for a new frame
_NICENESS = 5
_START_S = 60.0  # Largest time to import and to open a camera, s
_END_S = 2.0  # Largest time to release a camera, s


class Perception:
    """Detects a calibration's objects in its own process, within its context.

    ``open_camera``, a function or class of a module or a partial of one, is called in the new
    process. Its clock must be the same in all processes, as `time.monotonic` is. Raises the
    `InvalidInputError` of ``open_camera``, and one if the camera's size differs from the
    calibration's or there is no object to detect.
    """

    def __init__(self, open_camera: Callable[[], Camera], calibration: CameraCalibration) -> None:
        if not calibration.objects:
            raise InvalidInputError("the calibration names no objects: nothing can be watched")
        self._open_camera, self._calibration = open_camera, calibration

    def __enter__(self) -> "Perception":
        # Files that both processes have mapped may be removed.
        with TemporaryDirectory(prefix="contactgraph-", dir=MEMORY) as folder:
            paths = {name: Path(folder, str(i)) for i, name in enumerate(self._calibration.objects)}
            self._worker = WorkerProcess(
                "the camera's process",
                detect,
                paths,
                self._open_camera,
                self._calibration,
                nice=_NICENESS,
            )
            try:
                self._worker.receive(_START_S)
            except BaseException:
                self.__exit__()
                raise
            self._rings = {name: RingReader(path) for name, path in paths.items()}
        return self

    def __exit__(self, *raised: object) -> None:
        self._worker.close(_END_S)

    def check(self) -> None:
        """Raises the error that has ended the process, if any."""
        self._worker.check()

    def since(self, name: str, after: float = -math.inf) -> list[PositionMeasurement]:
        """An object's measurements exposed after ``after`` s: the newest five at most, in order."""
        ring = self._rings[name]
        # Most calls find nothing new.
        if not ring.count or not ring.newest()["time"] > after:
            return []
        return [
            PositionMeasurement(row["position"], row["covariance"], float(row["time"]))
            for row in ring.last(ring.count - _RETURNED)
            if row["time"] > after
        ]


def detect(
    connection: Connection,
    paths: dict[str, Path],
    open_camera: Callable[[], Camera],
    calibration: CameraCalibration,
) -> None:
    """Writes objects' positions in each new frame to the rings ``paths``.

    Sends None when the camera is open, and returns at a message or the end of the connection.
    """
    camera = open_camera()
    try:
        _check_size(camera.intrinsics, calibration.intrinsics)
        rings = {name: RingWriter(path, _FIELDS, _SLOTS) for name, path in paths.items()}
        detector = ObjectDetector(calibration)
        connection.send(None)
        while not connection.poll():
            frame = camera.read()
            if frame is None:
                time.sleep(_PAUSE)
                continue
            for name, found in detector.detect(frame).items():
                row = rings[name].begin()
                row["time"], row["position"] = frame.time, found.position
                row["covariance"] = found.covariance
                rings[name].publish()
    finally:
        camera.close()


def _check_size(found: Intrinsics, calibrated: Intrinsics) -> None:
    if (found.width, found.height) != (calibrated.width, calibrated.height):
        raise InvalidInputError(
            f"the camera gives {found.width} x {found.height} px, but was calibrated at "
            f"{calibrated.width} x {calibrated.height}"
        )
