"""The folder in memory by which other processes find a simulated robot."""

import json
import os
import shutil
import socket
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from contactgraph.data import InvalidInputError
from contactgraph.data.files import parse_json
from contactgraph_franka.shared_ring import MEMORY
from contactgraph_franka.sim.camera import CameraSettings

_PORTS = (1337, 1338)  # Ports of the protocol, for the arm and its gripper


@dataclass(frozen=True)
class Session:
    """Settings of a simulated robot, in a folder that its address determines."""

    address: str
    """A loopback address, such as 127.0.0.1."""
    pace: float
    """Wall seconds of a simulated second."""
    blocks: int
    mass: float
    """kg, of each block."""
    owner: int
    """Id of the process that started it."""
    camera: CameraSettings | None

    @property
    def folder(self) -> Path:
        """In `MEMORY`."""
        return MEMORY / f"contactgraph-{os.getuid()}-{self.address}"

    def create(self) -> None:
        """Makes the folder, replacing that of a dead owner.

        Raises `InvalidInputError` if another simulated robot runs at the address.
        """
        folder = self.folder
        if folder.exists():
            other = _owner(folder)
            if other is not None:
                raise InvalidInputError(
                    f"a simulated robot already runs at {self.address} (process {other}): close "
                    "it, or choose another address from 127.0.0.1 on"
                )
            shutil.rmtree(folder)
        folder.mkdir(mode=0o700)
        (folder / "session.json").write_text(json.dumps(asdict(self)))

    def remove(self) -> None:
        """Removes the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def read_session(folder: Path) -> Session:
    """The session that made ``folder``."""
    fields = parse_json((folder / "session.json").read_text())
    camera = fields.pop("camera")
    return Session(**fields, camera=None if camera is None else CameraSettings.from_dict(camera))


def find_session(address: str) -> Session:
    """The session that runs at ``address``; raises `InvalidInputError` if there is none."""
    folder = Session(address, 1.0, 0, 0.0, 0, None).folder
    if _owner(folder) is None:
        raise InvalidInputError(
            f"no simulated robot runs at {address}: start one with `contactgraph robot rehearse`"
        )
    return read_session(folder)


def free_address(candidates: Sequence[str]) -> str:
    """The first of the ``candidates`` whose ports are free.

    Raises `InvalidInputError` if there is none, or none is an address of this machine.
    """
    for address in candidates:
        if all(_is_free(address, port) for port in _PORTS):
            return address
    raise InvalidInputError(
        f"ports {_PORTS[0]} and {_PORTS[1]} are not free at {', '.join(candidates)}: another "
        "server runs there, or it is no address of this machine"
    )


def _is_free(address: str, port: int) -> bool:
    with socket.socket() as probe:
        # As the server does: connections that just ended do not occupy the port.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True


def _owner(folder: Path) -> int | None:
    """The living process that owns ``folder``."""
    try:
        owner = parse_json((folder / "session.json").read_text())["owner"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if not isinstance(owner, int):
        return None
    try:
        os.kill(owner, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass
    return owner
