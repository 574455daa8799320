"""What the processes of a rehearsal know of each other: a folder that its address names."""

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

_PORTS = (1337, 1338)
"""Of the arm and of its gripper: the protocol's own."""


@dataclass(frozen=True)
class Session:
    """How a rehearsal runs. Whoever knows the address can read it: see `attached`."""

    address: str
    """A loopback address, such as 127.0.0.1."""
    pace: float
    """Seconds on the wall for each simulated one."""
    blocks: int
    mass: float
    """kg, of each block."""
    owner: int
    """The process that ends when the rehearsal does."""
    camera: CameraSettings | None

    @property
    def folder(self) -> Path:
        """In memory, where the system has such files."""
        memory = Path("/dev/shm")
        place = memory if memory.is_dir() else Path(tempfile.gettempdir())
        return place / f"contactgraph-{os.getuid()}-{self.address}"

    def create(self) -> None:
        """Makes the folder; one whose owner is gone is replaced.

        Raises `InvalidInputError` where another rehearsal runs at the address.
        """
        folder = self.folder
        if folder.exists():
            other = _owner(folder)
            if other is not None and _alive(other):
                raise InvalidInputError(
                    f"a rehearsal already runs at {self.address} (process {other}): close it, or "
                    "choose another address from 127.0.0.1 on"
                )
            shutil.rmtree(folder)
        folder.mkdir(mode=0o700)
        (folder / "session.json").write_text(json.dumps(asdict(self)))

    def remove(self) -> None:
        """Removes the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def read_session(folder: Path) -> Session:
    """The session that made ``folder``."""
    told = parse_json((folder / "session.json").read_text())
    camera = told.pop("camera")
    return Session(**told, camera=None if camera is None else CameraSettings.from_dict(camera))


def attached(address: str) -> Session:
    """The session that runs at ``address``; raises `InvalidInputError` where there is none."""
    folder = Session(address, 1.0, 0, 0.0, 0, None).folder
    owner = _owner(folder)
    if owner is None or not _alive(owner):
        raise InvalidInputError(
            f"no rehearsal runs at {address}: start one with `contactgraph robot rehearse`"
        )
    return read_session(folder)


def free_address(candidates: Sequence[str]) -> str:
    """The first of the ``candidates`` at which nobody listens.

    Raises `InvalidInputError` where all are taken, or are no addresses of this machine.
    """
    for address in candidates:
        if all(_free(address, port) for port in _PORTS):
            return address
    raise InvalidInputError(
        f"ports {_PORTS[0]} and {_PORTS[1]} are not free at {', '.join(candidates)}: another "
        "server runs there, or it is no address of this machine"
    )


def _free(address: str, port: int) -> bool:
    with socket.socket() as probe:
        # As the server does it: connections that just ended do not keep the port.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True


def _owner(folder: Path) -> int | None:
    try:
        owner = parse_json((folder / "session.json").read_text())["owner"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return owner if isinstance(owner, int) else None


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


_START = 30.0
"""s: for so long a process may take to be ready."""
_END = 2.0
"""s: for so long it may take to end when asked to."""
_MISTAKE = "contactgraph.data.errors.InvalidInputError: "


class ChildProcess:
    """``python -m MODULE FOLDER``, whose last words are kept in the folder."""

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
                # Ctrl-C is for the owner to answer.
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
        """Raises what the process died of: `InvalidInputError`, or else `RuntimeError`."""
        code = self._process.poll()
        if code is None:
            return
        words = self._log.read_text().strip().splitlines() if self._log.exists() else []
        last = words[-1] if words else "without a word"
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
