"""Perception without a loadable library, and the clock of a camera."""

import sys
from importlib import import_module

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception.camera import FrameClock

MODULE = "contactgraph_franka.perception.realsense"


@pytest.mark.parametrize(
    ("library", "module", "extra"),
    [
        ("pyrealsense2", MODULE, "realsense"),
        ("pyapriltags", "contactgraph_franka.perception.tags", "robot"),
    ],
)
def test_without_the_library_the_error_names_the_extra(library, module, extra, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(InvalidInputError, match=rf"pip install 'contactgraph\[{extra}\]'$"):
        import_module(module)


@pytest.fixture
def broken(tmp_path, monkeypatch):
    """A library that is there and cannot be loaded."""
    (tmp_path / "pyrealsense2.py").write_text("raise ImportError('libodd.so.7: no such file')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    monkeypatch.delitem(sys.modules, MODULE, raising=False)


def test_a_library_that_cannot_be_loaded_is_reported_with_the_reason(broken):
    pytest.importorskip("libusb_package", reason="the extra realsense is not installed")
    with pytest.raises(InvalidInputError, match=r"cannot be loaded: libodd\.so\.7: no such file$"):
        import contactgraph_franka.perception.realsense  # noqa: F401


def test_the_error_names_the_extra_if_nothing_can_be_loaded(broken, monkeypatch):
    monkeypatch.setitem(sys.modules, "libusb_package", None)
    with pytest.raises(InvalidInputError, match="need libusb_package: pip install"):
        import contactgraph_franka.perception.realsense  # noqa: F401


def test_a_devices_clock_is_set_by_its_quickest_frame():
    now = 0.0
    clock = FrameClock(lambda: now)
    delays = []
    for number, way in enumerate((0.030, 0.021, 0.055, 0.020)):
        now = 100.0 + number / 30.0 + way
        delays.append(clock.from_device(7.0 + number / 30.0) - 100.0 - number / 30.0)
    np.testing.assert_allclose(delays, [0.030, 0.021, 0.021, 0.020], atol=1e-9)
