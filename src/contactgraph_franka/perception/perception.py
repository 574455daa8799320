"""Object detection in a process of its own, and its measurements in shared memory."""

import math
import multiprocessing
import signal
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
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

_TIME, _FRAMES, _LOST = range(3)
_POSITION, _COVARIANCE = slice(3, 6), slice(6, 15)
_NUMBERS = 15
"""Numbers in a row, at the indices above; fields of a structured array read much slower."""
_ROWS = 8
"""Rows of an object: all but the oldest are valid while the next is written, however long its
writer waits for a core."""
_RETURNED = 5
"""Of those, at most so many are returned; a reader has three frames' time to copy them."""
_LATENCY = 3
"""Numbers: frames, the sum of their latencies, the largest latency [s]."""
_PAUSE = 0.001
"""s between polls for a new frame."""
_NICENESS = 5
_START_S = 60.0
"""Largest time to import and to open a camera, s."""


@dataclass(frozen=True)
class DetectionCounts:
    """Frames so far, and those without the object."""

    frames: int
    lost: int


@dataclass(frozen=True)
class PerceptionReport:
    """Detections and latency so far."""

    frames: int
    latency: float
    """s, mean, from the exposure of a frame to the availability of its measurements."""
    longest_latency: float
    """s"""
    objects: Mapping[str, DetectionCounts]


class SharedMeasurements:
    """The newest measurements of each of ``count`` objects. One process writes, others read."""

    def __init__(self, count: int, context: BaseContext) -> None:
        self._count = count
        self._memory: Any = context.RawArray("d", count * (_ROWS * _NUMBERS + 1) + _LATENCY)
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
        self._latency = numbers[used : used + _LATENCY]
        self._written = numbers[used + _LATENCY :].view(np.int64)  # number of writes

    def write(self, index: int, seen: PositionMeasurement | None, counts: DetectionCounts) -> None:
        """Publishes an object's newest measurement, None before the first, and its counts."""
        written = int(self._written[index]) + 1
        row = self._rows[index, written % _ROWS]
        row[_TIME] = -np.inf
        if seen is not None:
            row[_TIME] = seen.time
            row[_POSITION], row[_COVARIANCE] = seen.position, seen.covariance.ravel()
        row[_FRAMES], row[_LOST] = counts.frames, counts.lost
        # Last: the processors that the arm's library supports keep the order of writes.
        self._written[index] = written

    def since(self, index: int, after: float = -np.inf) -> list[PositionMeasurement]:
        """An object's measurements later than ``after`` s, the newest five at most, in order."""
        newest = int(self._written[index])
        # Most calls find nothing new.
        if not newest or not self._rows[index, newest % _ROWS, _TIME] > after:
            return []
        found: list[PositionMeasurement] = []
        for row in self._copied(index, _RETURNED):
            moment = float(row[_TIME])
            # A frame without the object repeats the previous measurement.
            if moment > after:
                covariance = row[_COVARIANCE].reshape(3, 3)
                found.append(PositionMeasurement(row[_POSITION], covariance, moment))
                after = moment
        return found

    def counts(self, index: int) -> DetectionCounts:
        """An object's newest counts."""
        if not self._written[index]:
            return DetectionCounts(0, 0)
        (row,) = self._copied(index, 1)
        return DetectionCounts(int(row[_FRAMES]), int(row[_LOST]))

    def add_frame(self, latency: float) -> None:
        """Counts a frame whose measurements came ``latency`` s after its exposure."""
        frames, total, longest = self._latency
        self._latency[:] = frames + 1, total + latency, max(longest, latency)

    def latency(self) -> tuple[int, float, float]:
        """Frames so far, and the mean and largest latency [s]."""
        frames, total, longest = self._latency.tolist()
        return int(frames), total / frames if frames else float("nan"), longest

    def _copied(self, index: int, most: int) -> np.ndarray:
        """[K, 15]: the newest K <= ``most`` rows, the oldest first."""
        while True:
            written = int(self._written[index])
            wanted = np.arange(max(written - most, 0) + 1, written + 1)
            rows = self._rows[index, wanted % _ROWS]
            if self._written[index] - written < _ROWS - most:
                return rows


class DetectionLoop:
    """Detects the objects in each new frame and publishes their positions."""

    def __init__(
        self,
        camera: Camera,
        calibration: CameraCalibration,
        shared: SharedMeasurements,
        clock: Callable[[], float],
    ) -> None:
        """``clock`` is the one that frames are stamped with."""
        self._camera, self._shared, self._clock = camera, shared, clock
        self._detector = ObjectDetector(calibration)
        self._newest: dict[str, PositionMeasurement | None] = dict.fromkeys(calibration.objects)
        self._counts = {name: DetectionCounts(0, 0) for name in calibration.objects}

    def step(self) -> bool:
        """Processes the newest frame; False if there is none."""
        frame = self._camera.read()
        if frame is None:
            return False
        estimates = self._detector.detect(frame)
        for index, name in enumerate(self._newest):
            found = estimates.get(name)
            if found is not None:
                self._newest[name] = PositionMeasurement(
                    found.position, found.covariance, frame.time
                )
            count = self._counts[name]
            count = DetectionCounts(count.frames + 1, count.lost + (found is None))
            self._counts[name] = count
            self._shared.write(index, self._newest[name], count)
        self._shared.add_frame(self._clock() - frame.time)
        return True


class Perception:
    """Detects a calibration's objects in its own process. A context manager, or `start`, `close`.

    ``open_camera``, a function or class of a module or a partial of one, is called in the new
    process. ``clock``, likewise, stamps frames and must be the same in all processes, as
    `time.monotonic` is.

    A thread would share Python's interpreter lock with a control loop of 1 ms
    (benchmarks/tag_pose.py measures both). Raises the `InvalidInputError` of ``open_camera``, and
    one if the camera's size differs from the calibration's or there is no object to detect.
    """

    def __init__(
        self,
        open_camera: Callable[[], Camera],
        calibration: CameraCalibration,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not calibration.objects:
            raise InvalidInputError("the calibration names no objects: nothing can be watched")
        self._names = tuple(calibration.objects)
        context = multiprocessing.get_context("spawn")
        self._shared = SharedMeasurements(len(self._names), context)
        self._connection, remote = context.Pipe()
        self._remote: Connection | None = remote
        self._process = context.Process(
            target=_run,
            args=(remote, self._shared, open_camera, calibration, clock),
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
        if self._remote is not None:
            self._remote.close()
            self._remote = None
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

    def report(self) -> PerceptionReport:
        """Frames, lost frames, and latency so far."""
        frames, mean, longest = self._shared.latency()
        objects = {name: self._shared.counts(index) for index, name in enumerate(self._names)}
        return PerceptionReport(frames, mean, longest, objects)


def _run(
    connection: Connection,
    shared: SharedMeasurements,
    open_camera: Callable[[], Camera],
    calibration: CameraCalibration,
    clock: Callable[[], float],
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
            loop = DetectionLoop(camera, calibration, shared, clock)
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
