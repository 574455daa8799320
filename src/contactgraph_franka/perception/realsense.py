"""Intel RealSense depth cameras. No other module imports pyrealsense2."""

import ctypes
import math
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception.camera import CameraFrame, FrameClock, Intrinsics


def _load() -> ModuleType:
    """pyrealsense2, with the libusb of a package if the system has none."""
    try:
        import pyrealsense2
    except ModuleNotFoundError:
        raise
    except ImportError:
        import libusb_package

        # The dynamic linker finds a library that is already loaded by its name.
        ctypes.CDLL(str(libusb_package.get_library_path()))
        import pyrealsense2
    return pyrealsense2


try:
    rs: Any = _load()
except ModuleNotFoundError as error:
    raise InvalidInputError(
        f"RealSense cameras need {error.name}: pip install 'contactgraph[realsense]'"
    ) from error
except (ImportError, OSError) as error:
    raise InvalidInputError(f"pyrealsense2 cannot be loaded: {error}") from error

_GREEN = 1  # The colour channel used as grey; half of the sensor's pixels measure it
_QUEUE = 4  # Largest number of unread frames


class RealSenseCamera:
    """A `Camera`: grey from its colour stream, and depth registered to it.

    ``serial`` selects one of several cameras; None: the first. ``device`` is an open device, such
    as the library's ``software_device``. Frames are stamped on ``clock`` with the middle of the
    exposure, from the driver's system or global time, or else by `FrameClock.from_device`. Raises
    `InvalidInputError` if there is no such camera or it has no such streams.
    """

    def __init__(
        self,
        serial: str | None = None,
        width: int = 1280,
        height: int = 720,
        rate: int = 30,
        *,
        device: Any = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        device = _attached(serial) if device is None else device
        colour = _profile(device, rs.stream.color, rs.format.rgb8, (width, height), rate)
        depth = _profile(device, rs.stream.depth, rs.format.z16, (width, height), rate)
        self._intrinsics = _intrinsics(colour.as_video_stream_profile().get_intrinsics())
        self._clock = FrameClock(clock)
        self._align = rs.align(rs.stream.color)
        self._frames = rs.syncer(_QUEUE)
        self._open: list[Any] = []
        # One sensor may have both streams, and is then opened once.
        for sensor in device.query_sensors():
            own = [each for each in (colour, depth) if _gives(sensor, each)]
            if own:
                sensor.open(own)
                sensor.start(self._frames)
                self._open.append(sensor)

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of the colour camera, as reported by the device."""
        return self._intrinsics

    def read(self) -> CameraFrame | None:
        """The newest frame, with depth if there is one of the same time."""
        newest = None
        while frames := self._frames.poll_for_frames():
            if frames.get_color_frame():
                newest = frames
        if newest is None:
            return None
        depth = None
        if newest.get_depth_frame():
            newest = self._align.process(newest)
            frame = newest.get_depth_frame()
            metres = np.float32(frame.get_units())
            depth = np.asanyarray(frame.get_data()).astype(np.float32) * metres
        colour = newest.get_color_frame()
        grey = np.ascontiguousarray(np.asanyarray(colour.get_data())[..., _GREEN])
        of_device = colour.frame_timestamp_domain == rs.timestamp_domain.hardware_clock
        seconds = colour.timestamp / 1000.0
        moment = self._clock.from_device(seconds) if of_device else self._clock.from_epoch(seconds)
        return CameraFrame(grey, depth, moment) if math.isfinite(moment) else None

    def close(self) -> None:
        """Stops the streams."""
        for sensor in self._open:
            sensor.stop()
            sensor.close()
        self._open.clear()


def _attached(serial: str | None) -> Any:
    found = {
        device.get_info(rs.camera_info.serial_number): device
        for device in rs.context().query_devices()
    }
    if not found:
        raise InvalidInputError("no RealSense camera is attached: check its cable and USB port")
    if serial is None:
        return next(iter(found.values()))
    if serial not in found:
        raise InvalidInputError(f"no RealSense camera {serial}; attached: {', '.join(found)}")
    return found[serial]


def _profile(device: Any, stream: Any, form: Any, size: tuple[int, int], rate: int) -> Any:
    """The stream's profile of this size and rate."""
    others = []
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if profile.stream_type() != stream or profile.format() != form:
                continue
            video = profile.as_video_stream_profile()
            if (video.width(), video.height()) == size and profile.fps() == rate:
                return profile
            others.append(f"{video.width()} x {video.height()} at {profile.fps()}")
    raise InvalidInputError(
        f"the camera gives no {stream.name} of {size[0]} x {size[1]} at {rate} Hz, but "
        f"{', '.join(sorted(set(others))) or 'none at all'}"
    )


def _gives(sensor: Any, profile: Any) -> bool:
    return any(each.unique_id() == profile.unique_id() for each in sensor.get_stream_profiles())


def _intrinsics(reported: Any) -> Intrinsics:
    """The device's lens model in this package's terms."""
    distortion = None
    if any(reported.coeffs):
        undistorted = (rs.distortion.none, rs.distortion.inverse_brown_conrady)
        if reported.model not in (*undistorted, rs.distortion.brown_conrady):
            raise InvalidInputError(
                f"the camera's lens model {reported.model.name} is not known here; known: "
                "brown_conrady, inverse_brown_conrady"
            )
        if reported.model == rs.distortion.brown_conrady:
            distortion = tuple(float(each) for each in reported.coeffs)
        elif reported.model == rs.distortion.inverse_brown_conrady:
            distortion = _inverted(reported)
    return Intrinsics(
        reported.fx,
        reported.fy,
        reported.ppx,
        reported.ppy,
        reported.width,
        reported.height,
        distortion,
    )


def _inverted(reported: Any) -> tuple[float, ...]:
    """Brown-Conrady coefficients for a lens whose inverse is reported, by linear least squares."""
    columns = np.linspace(0.0, reported.width - 1.0, 17)
    rows = np.linspace(0.0, reported.height - 1.0, 11)
    pixels = [[float(column), float(row)] for column in columns for row in rows]
    rays = [rs.rs2_deproject_pixel_to_point(reported, each, 1.0)[:2] for each in pixels]
    x, y = np.array(rays).T
    square = x * x + y * y
    distorted = (np.array(pixels) - (reported.ppx, reported.ppy)) / (reported.fx, reported.fy)
    terms = [
        np.stack([each * square, each * square**2, *tangential, each * square**3], axis=1)
        for each, tangential in (
            (x, (2.0 * x * y, square + 2.0 * x * x)),
            (y, (square + 2.0 * y * y, 2.0 * x * y)),
        )
    ]
    shift = (distorted - np.stack([x, y], 1)).T.ravel()
    return tuple(np.linalg.lstsq(np.concatenate(terms), shift, rcond=None)[0].tolist())
