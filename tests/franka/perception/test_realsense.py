"""A synthetic device feeds frames through the vendor's own library: no camera is needed."""

import time
from importlib.util import find_spec

import numpy as np
import pytest

from contactgraph.data import InvalidInputError

if find_spec("pyrealsense2") is None:
    pytest.skip("the extra realsense is not installed", allow_module_level=True)
from contactgraph_franka.perception.realsense import RealSenseCamera, rs

WIDTH, HEIGHT = 320, 240
APART = 0.015
"""m from the depth camera to the colour camera."""


class Device:
    """The synthetic streams of a RealSense, 15 mm apart."""

    def __init__(self, model=rs.distortion.none, coeffs=(0.0,) * 5):
        self.device = rs.software_device()
        self.colour, self.depth = self.device.add_sensor("Color"), self.device.add_sensor("Depth")
        self.colour_profile = self.colour.add_video_stream(
            stream(rs.stream.color, rs.format.rgb8, 3, 1, model, coeffs)
        )
        self.depth_profile = self.depth.add_video_stream(
            stream(rs.stream.depth, rs.format.z16, 2, 2, rs.distortion.none, (0.0,) * 5)
        )
        self.depth.add_read_only_option(rs.option.depth_units, 0.001)
        apart = rs.extrinsics()
        apart.rotation, apart.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [APART, 0, 0]
        self.depth_profile.register_extrinsics_to(self.colour_profile, apart)
        self.device.create_matcher(rs.matchers.dlr_c)

    def show(self, number, colour, depth, moment, domain=rs.timestamp_domain.hardware_clock):
        """Frames of the given moment [s], as if a camera had sent them."""
        for sensor, profile, pixels in (
            (self.depth, self.depth_profile, depth),
            (self.colour, self.colour_profile, colour),
        ):
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp = pixels, pixels.nbytes // (WIDTH * HEIGHT)
            frame.stride = WIDTH * frame.bpp
            frame.timestamp, frame.domain, frame.frame_number = 1000.0 * moment, domain, number
            frame.profile = profile.as_video_stream_profile()
            sensor.on_video_frame(frame)


def stream(kind, form, size, uid, model, coeffs):
    made = rs.video_stream()
    made.type, made.index, made.uid, made.fmt, made.bpp = kind, 0, uid, form, size
    made.width, made.height, made.fps = WIDTH, HEIGHT, 30
    lens = rs.intrinsics()
    lens.width, lens.height = WIDTH, HEIGHT
    lens.fx, lens.fy, lens.ppx, lens.ppy = 300, 301, 160, 119
    lens.model, lens.coeffs = model, list(coeffs)
    made.intrinsics = lens
    return made


def picture():
    """A white square on green, and its depth: 1 m before 2 m."""
    colour = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    colour[..., 1] = 40
    colour[100:140, 140:180] = 200
    depth = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    depth[100:140, 140:180] = 1000
    return colour, depth


def newest(camera, device, domain, late=0.0):
    """The library pairs streams by their times, in threads of its own, once it knows the rhythm."""
    for number in range(60):
        device.show(number, *picture(), time.time() - late, domain)
        time.sleep(1.0 / 30.0)
        frame = camera.read()
        if frame is not None and frame.depth is not None:
            return frame
    raise AssertionError("no frame came")


@pytest.fixture
def device():
    return Device()


def test_grey_and_depth_come_through_the_library(device):
    camera = RealSenseCamera(width=WIDTH, height=HEIGHT, device=device.device, clock=lambda: 50.0)
    assert camera.intrinsics.fx == 300 and camera.intrinsics.cy == 119
    assert camera.intrinsics.distortion is None
    assert camera.read() is None
    frame = newest(camera, device, rs.timestamp_domain.hardware_clock)
    colour, _ = picture()
    np.testing.assert_array_equal(frame.image, colour[..., 1])
    # As the colour camera sees it, 15 mm to the left of the depth camera: 4.5 px at 1 m.
    assert frame.depth[120, 170] == pytest.approx(1.0, abs=1e-6)
    assert frame.depth[120, 50] == pytest.approx(2.0, abs=1e-6)
    assert frame.depth[120, 182] == pytest.approx(1.0, abs=1e-6)
    assert frame.depth[120, 141] != pytest.approx(1.0, abs=1e-6)
    # The clock stands still, so the last frame came quickest.
    assert frame.time == pytest.approx(50.0, abs=1e-6)
    assert camera.read() is None
    camera.close()


def test_system_times_are_mapped_to_the_readers_clock(device):
    camera = RealSenseCamera(width=WIDTH, height=HEIGHT, device=device.device)
    frame = newest(camera, device, rs.timestamp_domain.system_time, late=0.5)
    assert 0.5 < time.monotonic() - frame.time < 0.6
    camera.close()


def test_an_inverse_distortion_is_inverted():
    coeffs = (0.08, -0.05, 0.001, -0.002, 0.01)
    device = Device(rs.distortion.inverse_brown_conrady, coeffs)
    camera = RealSenseCamera(width=WIDTH, height=HEIGHT, device=device.device)
    lens = device.colour_profile.as_video_stream_profile().get_intrinsics()
    for pixel in ([0.0, 0.0], [160.0, 119.0], [300.0, 200.0], [20.0, 220.0]):
        expected = rs.rs2_deproject_pixel_to_point(lens, pixel, 1.0)
        ours = camera.intrinsics.rays(np.array(pixel))
        # A hundredth of a pixel.
        np.testing.assert_allclose(ours, expected[:2], atol=0.01 / 300)
    camera.close()


def test_the_error_of_a_missing_stream_lists_the_others(device):
    with pytest.raises(InvalidInputError) as error:
        RealSenseCamera(width=640, height=480, device=device.device)
    said = "the camera gives no color of 640 x 480 at 30 Hz, but 320 x 240 at 30"
    assert str(error.value) == said


def test_without_a_camera_there_is_one_line():
    if len(rs.context().query_devices()):
        pytest.skip("a RealSense camera is attached here")
    with pytest.raises(InvalidInputError, match=r"^no RealSense camera is attached: check"):
        RealSenseCamera()
