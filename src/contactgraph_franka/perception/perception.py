"""What the camera's process knows, in memory that the robot's loop reads without waiting."""

import math
import multiprocessing
import signal
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop.realtime import set_nice
from contactgraph_franka.perception.calibration import CameraCalibration
from contactgraph_franka.perception.camera import Camera, Intrinsics
from contactgraph_franka.perception.detector import ObjectDetector

_TIME, _FRAMES, _LOST = range(3)
_POSITION, _COVARIANCE = slice(3, 6), slice(6, 15)
_NUMBERS = 15
"""Numbers in a slot, by the places above. Plain ones: fields take several times as long to read."""
_SLOTS = 8
"""Of an object. All but the oldest are whole while the next is written, however long its writer
must wait for a core."""
_TOLD = 5
"""Of those, at most so many are told; a reader has three frames' time to copy them."""
_LATENCY = 3
"""Numbers: frames, the sum of their latencies, the longest [s]."""


@dataclass(frozen=True, eq=False, slots=True)
class PositionMeasurement:
    """Where a frame showed an object, in the frame of the robot's base."""

    position: np.ndarray
    """[3] m"""
    covariance: np.ndarray
    """[3, 3] m^2"""
    time: float
    """s: the exposure."""


@dataclass(frozen=True)
class DetectionCounts:
    """What became of an object in all frames so far."""

    frames: int
    lost: int
    """Frames that did not show it."""


class SharedMeasurements:
    """The newest sighting of each of ``count`` objects. One process writes, others read."""

    def __init__(self, count: int, context: BaseContext) -> None:
        self._count = count
        self._memory: Any = context.RawArray("d", count * (_SLOTS * _NUMBERS + 1) + _LATENCY)
        self._map()

    def __getstate__(self) -> tuple[int, Any]:
        return self._count, self._memory

    def __setstate__(self, state: tuple[int, Any]) -> None:
        self._count, self._memory = state
        self._map()

    def _map(self) -> None:
        # Each process has its own arrays over the one memory.
        numbers = np.frombuffer(self._memory)
        used = self._count * _SLOTS * _NUMBERS
        self._rows = numbers[:used].reshape(self._count, _SLOTS, _NUMBERS)
        self._latency = numbers[used : used + _LATENCY]
        # How often each was written.
        self._written = numbers[used + _LATENCY :].view(np.int64)

    def write(self, index: int, seen: PositionMeasurement | None, counts: DetectionCounts) -> None:
        """Shows an object's newest sighting and its counts; None: no frame has shown it yet."""
        written = int(self._written[index]) + 1
        row = self._rows[index, written % _SLOTS]
        row[_TIME] = -np.inf
        if seen is not None:
            row[_TIME] = seen.time
            row[_POSITION], row[_COVARIANCE] = seen.position, seen.covariance.ravel()
        row[_FRAMES], row[_LOST] = counts.frames, counts.lost
        # Last, and the processors that an arm's library runs on keep to that.
        self._written[index] = written

    def since(self, index: int, after: float = -np.inf) -> list[PositionMeasurement]:
        """An object's sightings later than ``after`` s, the newest five at most, in order."""
        newest = int(self._written[index])
        # One look at the time first: most who ask have seen all.
        if not newest or not self._rows[index, newest % _SLOTS, _TIME] > after:
            return []
        found: list[PositionMeasurement] = []
        for row in self._copied(index, _TOLD):
            time = float(row[_TIME])
            # A frame that did not show the object tells once more where it was before.
            if time > after:
                found.append(
                    PositionMeasurement(row[_POSITION], row[_COVARIANCE].reshape(3, 3), time)
                )
                after = time
        return found

    def counts(self, index: int) -> DetectionCounts:
        """An object's newest counts."""
        if not self._written[index]:
            return DetectionCounts(0, 0)
        (row,) = self._copied(index, 1)
        return DetectionCounts(int(row[_FRAMES]), int(row[_LOST]))

    def add_frame(self, latency: float) -> None:
        """Counts a frame whose estimate came ``latency`` s after its exposure."""
        frames, total, longest = self._latency
        self._latency[:] = frames + 1, total + latency, max(longest, latency)

    def latency(self) -> tuple[int, float, float]:
        """Frames so far, and the mean and the longest time from exposure to estimate [s]."""
        frames, total, longest = self._latency.tolist()
        return int(frames), total / frames if frames else float("nan"), longest

    def _copied(self, index: int, most: int) -> np.ndarray:
        """[K, 15]: the newest K <= ``most`` rows, the oldest first."""
        while True:
            written = int(self._written[index])
            wanted = np.arange(max(written - most, 0) + 1, written + 1)
            rows = self._rows[index, wanted % _SLOTS]
            if self._written[index] - written < _SLOTS - most:
                return rows


class DetectionLoop:
    """Camera to tags to poses to places; ``clock`` tells the time that frames are stamped with."""

    def __init__(
        self,
        camera: Camera,
        calibration: CameraCalibration,
        shared: SharedMeasurements,
        clock: Callable[[], float],
    ) -> None:
        self._camera, self._shared, self._clock = camera, shared, clock
        self._detector = ObjectDetector(calibration)
        self._newest: dict[str, PositionMeasurement | None] = dict.fromkeys(calibration.objects)
        self._counts = {name: DetectionCounts(0, 0) for name in calibration.objects}

    def look(self) -> bool:
        """Takes the newest frame into account; False where there is none."""
        frame = self._camera.read()
        if frame is None:
            return False
        seen = self._detector.detect(frame)
        for index, name in enumerate(self._newest):
            found = seen.get(name)
            if found is not None:
                self._newest[name] = PositionMeasurement(
                    found.position, found.covariance, frame.time
                )
            count = self._counts[name]
            self._counts[name] = replace(
                count, frames=count.frames + 1, lost=count.lost + (found is None)
            )
            self._shared.write(index, self._newest[name], self._counts[name])
        self._shared.add_frame(self._clock() - frame.time)
        return True


_PAUSE = 0.001
"""s between looks for a new frame: little of the delay, and no load."""
_BEHIND = 5
"""How much the process yields to those that must be on time."""
_START_S = 60.0
"""For importing, and for opening a camera."""


@dataclass(frozen=True)
class PerceptionReport:
    """How seeing has gone so far."""

    frames: int
    latency: float
    """s, mean, from the exposure of a frame to when what it shows can be had."""
    longest_latency: float
    """s"""
    objects: Mapping[str, DetectionCounts]


class Perception:
    """Watches the objects of a calibration. A context manager, or `start` and `close`.

    ``open_camera`` is called in the new process: a function or class of a module, or a partial of
    one. ``clock`` is the one that frames are stamped with, likewise; it must be the same in all
    processes, as `time.monotonic` is.

    A process, not a thread: the library that finds tags lets other threads run, but poses
    are Python, and a loop of 1 ms beside them in one process waits for them
    (benchmarks/tag_pose.py measures both). Raises what ``open_camera`` raises if that is
    `InvalidInputError`, and `InvalidInputError` where the camera's size is not that of the
    calibration, or nothing is to be watched.
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
        self._connection, theirs = context.Pipe()
        self._theirs: Connection | None = theirs
        self._process = context.Process(
            target=_watch,
            args=(theirs, self._shared, open_camera, calibration, clock),
            daemon=True,
            name="perception",
        )

    def __enter__(self) -> "Perception":
        self.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def start(self) -> None:
        """Returns when the camera is open."""
        self._process.start()
        if self._theirs is not None:
            self._theirs.close()
            self._theirs = None
        try:
            if not self._connection.poll(_START_S):
                raise RuntimeError(f"the camera did not open within {_START_S:.0f} s")
            self.check()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Gives the camera back and ends the process."""
        with suppress(OSError):
            self._connection.send(None)
        if self._process.pid is not None:
            self._process.join(timeout=2.0)
            self._process.kill()
            self._process.join()
        self._connection.close()

    def check(self) -> None:
        """Raises what has ended the process, if something has: then nothing is tracked any more."""
        answer = None
        try:
            while self._connection.poll():
                answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise RuntimeError("the camera's process has ended") from error
        if isinstance(answer, BaseException):
            raise answer

    def since(self, name: str, after: float = -math.inf) -> list[PositionMeasurement]:
        """Where frames exposed after ``after`` s show an object: the newest five at most, in order.

        Takes a microsecond where there is nothing new."""
        return self._shared.since(self._names.index(name), after)

    def report(self) -> PerceptionReport:
        """Frames, lost frames, and latency so far."""
        frames, mean, longest = self._shared.latency()
        objects = {name: self._shared.counts(index) for index, name in enumerate(self._names)}
        return PerceptionReport(frames, mean, longest, objects)


def _watch(
    connection: Connection,
    shared: SharedMeasurements,
    open_camera: Callable[[], Camera],
    calibration: CameraCalibration,
    clock: Callable[[], float],
) -> None:
    """The camera's process: tells None when it begins, and the error that ends it."""
    # Ctrl-C is for the loop, which ends its run gently, and then this.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_nice(_BEHIND)
    try:
        camera = open_camera()
        try:
            _check_size(camera.intrinsics, calibration.intrinsics)
            watch = DetectionLoop(camera, calibration, shared, clock)
            connection.send(None)
            # Whatever is said, or that nobody is there any more, ends it.
            while not connection.poll():
                if not watch.look():
                    time.sleep(_PAUSE)
        finally:
            camera.close()
    except InvalidInputError as error:
        _tell(connection, error)
    except Exception:
        _tell(
            connection, RuntimeError("the camera's process broke down:\n" + traceback.format_exc())
        )


def _tell(connection: Connection, error: Exception) -> None:
    with suppress(OSError):
        connection.send(error)


def _check_size(found: Intrinsics, calibrated: Intrinsics) -> None:
    if (found.width, found.height) != (calibrated.width, calibrated.height):
        raise InvalidInputError(
            f"the camera gives {found.width} x {found.height} px, but was calibrated at "
            f"{calibrated.width} x {calibrated.height}"
        )
