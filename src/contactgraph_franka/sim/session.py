"""The simulated robot's processes, and the folder in memory by which others find them."""

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from contactgraph.data import InvalidInputError
from contactgraph.data.json_fields import parse_json
from contactgraph_franka.sim.camera import CameraSettings

_PORTS = (1337, 1338)  # Ports of the protocol, for the arm and its gripper
_START = 30.0  # Largest time of a process to be ready, s
_END = 2.0  # Largest time of a process to end on request, s
_MISTAKE = "contactgraph.data.errors.InvalidInputError: "


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
        """In shared memory, if the system has it."""
        memory = Path("/dev/shm")
        parent = memory if memory.is_dir() else Path(tempfile.gettempdir())
        return parent / f"contactgraph-{os.getuid()}-{self.address}"

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


class ChildProcess:
    """``python -m MODULE FOLDER``, with its output in a log file of the folder."""

    def __init__(self, module: str, folder: Path, environment: Mapping[str, str] | None = None):
        self._module = module
        self._log = folder / f"{module.rpartition('.')[2]}.log"
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, str(folder)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **(environment or {})},
                # Ctrl-C is for the owner to handle.
                start_new_session=True,
            )

    def wait_until(self, ready: Callable[[], bool]) -> None:
        """Waits until ``ready()``; raises as `check` does, and `RuntimeError` after 30 s."""
        until = time.monotonic() + _START
        while not ready():
            self.check()
            if time.monotonic() > until:
                raise RuntimeError(f"{self._module} was not ready within {_START:.0f} s")
            time.sleep(0.01)

    def check(self) -> None:
        """Raises the error that ended the process: `InvalidInputError`, or `RuntimeError`."""
        code = self._process.poll()
        if code is None:
            return
        lines = self._log.read_text().strip().splitlines() if self._log.exists() else []
        last = lines[-1] if lines else "without a word"
        if last.startswith(_MISTAKE):
            raise InvalidInputError(last.removeprefix(_MISTAKE))
        raise RuntimeError(f"{self._module} ended with code {code}: {last}")

    def close(self) -> None:
        """Ends it."""
        self._process.terminate()
        try:
            self._process.wait(_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


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
