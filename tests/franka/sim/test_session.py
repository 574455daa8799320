"""The folder by which processes find a simulated robot."""

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from contactgraph.data import InvalidInputError
from contactgraph_franka.sim.camera import CameraSettings
from contactgraph_franka.sim.session import Session, find_session, free_address

ADDRESS = "127.0.7.1"


def session(owner: int, camera: CameraSettings | None = None) -> Session:
    return Session(ADDRESS, 2.0, 1, 0.83, owner, camera)


@pytest.fixture(autouse=True)
def clean() -> Iterator[None]:
    yield
    session(0).remove()


def test_an_address_identifies_its_session() -> None:
    made = session(os.getpid(), CameraSettings(delay=0.05, grey_noise=3.0))
    made.create()
    assert find_session(ADDRESS) == made


def test_only_the_session_of_a_dead_owner_is_replaced() -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    session(gone.pid).create()
    with pytest.raises(InvalidInputError, match=r"no simulated robot runs at 127\.0\.7\.1"):
        find_session(ADDRESS)
    session(os.getpid()).create()
    with pytest.raises(InvalidInputError, match=rf"already runs at .* \(process {os.getpid()}\)"):
        session(os.getpid()).create()


def test_addresses_of_other_machines_are_not_free() -> None:
    assert free_address(["192.0.2.1", ADDRESS]) == ADDRESS
    with pytest.raises(InvalidInputError, match=r"1337 and 1338 are not free at 192\.0\.2\.1"):
        free_address(["192.0.2.1"])
