"""Seeing in a process of its own, beside the robot's loop."""

import math
import multiprocessing
import signal
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop.undisturbed import give_way
from contactgraph_franka.perception.calibration import CameraCalibration
from contactgraph_franka.perception.camera import Camera, Intrinsics
from contactgraph_franka.perception.shared_sightings import (
    Measured,
    SharedSightings,
    SightCounts,
)
from contactgraph_franka.perception.watch import Watch

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
    objects: Mapping[str, SightCounts]


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
        self._shared = SharedSightings(len(self._names), context)
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

    def since(self, name: str, after: float = -math.inf) -> list[Measured]:
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
    shared: SharedSightings,
    open_camera: Callable[[], Camera],
    calibration: CameraCalibration,
    clock: Callable[[], float],
) -> None:
    """The camera's process: tells None when it begins, and the error that ends it."""
    # Ctrl-C is for the loop, which ends its run gently, and then this.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    give_way(_BEHIND)
    try:
        camera = open_camera()
        try:
            _check_size(camera.intrinsics, calibration.intrinsics)
            watch = Watch(camera, calibration, shared, clock)
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
