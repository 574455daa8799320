"""Object detection in a process of its own, and its measurements in shared memory."""

import math
import multiprocessing
import signal
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop.realtime import set_nice
from contactgraph_franka.perception.calibration import CameraCalibration
from contactgraph_franka.perception.camera import Camera, Intrinsics
from contactgraph_franka.perception.detector import ObjectDetector
from contactgraph_franka.perception.tracker import PositionMeasurement

_TIME, _POSITION, _COVARIANCE = 0, slice(1, 4), slice(4, 13)
_NUMBERS = 13
"""Numbers in a row, at the indices above; fields of a structured array read much slower."""
_ROWS = 8
"""Rows of an object: all but the oldest are valid while the next is written, however long its
writer waits for a core."""
_RETURNED = 5
"""Of those, at most so many are returned; a reader has three frames' time to copy them."""
_PAUSE = 0.001  # s between polls for a new frame
_NICENESS = 5
_START_S = 60.0  # Largest time to import and to open a camera, s


class SharedMeasurements:
    """The newest measurements of each of ``count`` objects. One process writes, others read."""

    def __init__(self, count: int, context: BaseContext) -> None:
        self._count = count
        self._memory: Any = context.RawArray("d", count * (_ROWS * _NUMBERS + 1))
        self._map()

    def __getstate__(self) -> tuple[int, Any]:
        return self._count, self._memory

    def __setstate__(self, state: tuple[int, Any]) -> None:
        self._count, self._memory = state
        self._map()

    def _map(self) -> None:
        # Each process has its own arrays over the shared memory.
        numbers = np.frombuffer(self._memory)
        used = self._count * _ROWS * _NUMBERS
        self._rows = numbers[:used].reshape(self._count, _ROWS, _NUMBERS)
        self._written = numbers[used:].view(np.int64)  # number of writes

    def write(self, index: int, measurement: PositionMeasurement) -> None:
        """Publishes an object's newest measurement."""
        written = int(self._written[index]) + 1
        row = self._rows[index, written % _ROWS]
        row[_TIME], row[_POSITION] = measurement.time, measurement.position
        row[_COVARIANCE] = measurement.covariance.ravel()
        # Last: the processors that the arm's library supports keep the order of writes.
        self._written[index] = written

    def since(self, index: int, after: float = -np.inf) -> list[PositionMeasurement]:
        """An object's measurements later than ``after`` s, the newest five at most, in order."""
        newest = int(self._written[index])
        # Most calls find nothing new.
        if not newest or not self._rows[index, newest % _ROWS, _TIME] > after:
            return []
        return [
            PositionMeasurement(row[_POSITION], row[_COVARIANCE].reshape(3, 3), float(row[_TIME]))
            for row in self._newest(index)
            if row[_TIME] > after
        ]

    def _newest(self, index: int) -> np.ndarray:
        """[K, 13]: the newest rows, the oldest first."""
        while True:
            written = int(self._written[index])
            wanted = np.arange(max(written - _RETURNED, 0) + 1, written + 1)
            rows = self._rows[index, wanted % _ROWS]
            if self._written[index] - written < _ROWS - _RETURNED:
                return rows


class DetectionLoop:
    """Detects the objects in each new frame and publishes their positions."""

    def __init__(
        self, camera: Camera, calibration: CameraCalibration, shared: SharedMeasurements
    ) -> None:
        self._camera, self._shared = camera, shared
        self._detector = ObjectDetector(calibration)
        self._indices = {name: index for index, name in enumerate(calibration.objects)}

    def step(self) -> bool:
        """Processes the newest frame; False if there is none."""
        frame = self._camera.read()
        if frame is None:
            return False
        for name, found in self._detector.detect(frame).items():
            measurement = PositionMeasurement(found.position, found.covariance, frame.time)
            self._shared.write(self._indices[name], measurement)
        return True


class Perception:
    """Detects a calibration's objects in its own process. A context manager, or `start`, `close`.

    ``open_camera``, a function or class of a module or a partial of one, is called in the new
    process. Its clock must be the same in all processes, as `time.monotonic` is.

    A thread would share Python's interpreter lock with a control loop of 1 ms
    (benchmarks/tag_pose.py measures both). Raises the `InvalidInputError` of ``open_camera``, and
    one if the camera's size differs from the calibration's or there is no object to detect.
    """

    def __init__(self, open_camera: Callable[[], Camera], calibration: CameraCalibration) -> None:
        if not calibration.objects:
            raise InvalidInputError("the calibration names no objects: nothing can be watched")
        self._names = tuple(calibration.objects)
        context = multiprocessing.get_context("spawn")
        self._shared = SharedMeasurements(len(self._names), context)
        self._connection, self._remote = context.Pipe()
        self._process = context.Process(
            target=_run,
            args=(self._remote, self._shared, open_camera, calibration),
            daemon=True,
            name="perception",
        )

    def __enter__(self) -> "Perception":
        self.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def start(self) -> None:
        """Returns once the camera is open."""
        self._process.start()
        self._remote.close()
        try:
            if not self._connection.poll(_START_S):
                raise RuntimeError(f"the camera did not open within {_START_S:.0f} s")
            self.check()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Releases the camera and ends the process."""
        with suppress(OSError):
            self._connection.send(None)
        if self._process.pid is not None:
            self._process.join(timeout=2.0)
            self._process.kill()
            self._process.join()
        self._connection.close()

    def check(self) -> None:
        """Raises the error that has ended the process, if any."""
        answer = None
        try:
            while self._connection.poll():
                answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise RuntimeError("the camera's process has ended") from error
        if isinstance(answer, BaseException):
            raise answer

    def since(self, name: str, after: float = -math.inf) -> list[PositionMeasurement]:
        """An object's measurements exposed after ``after`` s: the newest five at most, in order."""
        return self._shared.since(self._names.index(name), after)


def _run(
    connection: Connection,
    shared: SharedMeasurements,
    open_camera: Callable[[], Camera],
    calibration: CameraCalibration,
) -> None:
    """The camera's process; sends None when the camera is open, and the error that ends it."""
    # Ctrl-C is for the control loop, which then closes this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_nice(_NICENESS)
    error: Exception
    try:
        camera = open_camera()
        try:
            _check_size(camera.intrinsics, calibration.intrinsics)
            loop = DetectionLoop(camera, calibration, shared)
            connection.send(None)
            # A message, or the end of the other process, ends the loop.
            while not connection.poll():
                if not loop.step():
                    time.sleep(_PAUSE)
            return
        finally:
            camera.close()
    except InvalidInputError as invalid:
        error = invalid
    except Exception:
        error = RuntimeError("the camera's process broke down:\n" + traceback.format_exc())
    with suppress(OSError):
        connection.send(error)


def _check_size(found: Intrinsics, calibrated: Intrinsics) -> None:
    if (found.width, found.height) != (calibrated.width, calibrated.height):
        raise InvalidInputError(
            f"the camera gives {found.width} x {found.height} px, but was calibrated at "
            f"{calibrated.width} x {calibrated.height}"
        )
