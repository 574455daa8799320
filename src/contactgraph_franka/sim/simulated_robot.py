"""A rehearsal from start to end, and how other processes find one."""

import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop.realtime import WallClock
from contactgraph_franka.perception.calibration import CameraCalibration
from contactgraph_franka.perception.camera import pose, rotation_of
from contactgraph_franka.sim.blocks import MASS, block_names, scene_blocks
from contactgraph_franka.sim.camera import CameraSettings, SimulatedCamera
from contactgraph_franka.sim.session import ChildProcess, Session, attached, free_address
from contactgraph_franka.sim.shared_state import (
    GroundTruth,
    ServerReport,
    read_places,
    read_report,
    request_block_pose,
)

ADDRESSES = tuple(f"127.0.0.{number}" for number in range(1, 10))
"""Where a rehearsal may listen: the first free one."""
_PARTS = "contactgraph_franka.sim"


class SimulatedRobot:
    """A rehearsal that runs, in whatever process it was started: see `attach`."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._truth = GroundTruth(session.folder, session.blocks, read_places(session.folder))

    @property
    def address(self) -> str:
        """Where the arm's client finds the server."""
        return self._session.address

    @property
    def pace(self) -> float:
        """Seconds on the wall for each simulated one."""
        return self._session.pace

    @property
    def clock(self) -> WallClock:
        """The reader's clock, on which all is stamped. It goes slower by `pace`."""
        return WallClock(self._session.pace)

    @property
    def ground_truth(self) -> GroundTruth:
        """What is really so: for measuring, never for control."""
        return self._truth

    def place_block(self, index: int, position: np.ndarray, yaw: float = 0.0) -> None:
        """Puts block ``index`` at ``position`` [3] m, turned by ``yaw`` rad, at rest.

        Raises `InvalidInputError` for no such block or no such place.
        """
        place = np.asarray(position, dtype=np.float64)
        if not 0 <= index < self._session.blocks:
            raise InvalidInputError(f"block must be 0 to {self._session.blocks - 1}, found {index}")
        if place.shape != (3,) or not np.isfinite([*place, yaw]).all():
            raise InvalidInputError(f"position must be [3] m, and yaw rad, found {position}, {yaw}")
        request_block_pose(self._session.folder, index, place, yaw)

    def camera(self) -> SimulatedCamera:
        """The camera; raises `InvalidInputError` where the rehearsal has none."""
        settings = self._settings()
        return SimulatedCamera(
            self._session.folder, settings.intrinsics, settings.depth_noise is not None
        )

    def calibration(
        self, shift: Sequence[float] = (0.0, 0.0, 0.0), turn: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> CameraCalibration:
        """Where the camera really is, and the tags of the blocks; or what one that errs would say.

        ``shift`` [3] m is by how much it mistakes the camera's place, ``turn`` [3] rad by how much
        its direction, as a rotation vector; both in the frame of the arm's base. Raises
        `InvalidInputError` where the rehearsal has no camera.
        """
        settings = self._settings()
        told = pose(
            rotation_of(np.asarray(turn)) @ settings.pose[:3, :3],
            settings.pose[:3, 3] + np.asarray(shift),
        )
        blocks = scene_blocks(self._session.blocks)
        tagged = [block.tagged for block in blocks]
        objects = dict(zip(block_names(len(blocks)), tagged, strict=True))
        made = datetime.now(UTC).isoformat(timespec="seconds")
        return CameraCalibration(settings.intrinsics, told, objects, made)

    def report(self) -> ServerReport:
        """How well the server has kept time."""
        report = read_report(self._session.folder)
        if report is None:
            raise InvalidInputError(f"the rehearsal at {self.address} has ended")
        return report

    def _settings(self) -> CameraSettings:
        if self._session.camera is None:
            raise InvalidInputError(f"the rehearsal at {self.address} has no camera")
        return self._session.camera


def attach(address: str) -> SimulatedRobot:
    """The rehearsal at ``address``; raises `InvalidInputError` where there is none."""
    return SimulatedRobot(attached(address))


def open_camera(address: str) -> SimulatedCamera:
    """The camera of the rehearsal at ``address``, for a process that is told no more than that.

    Raises `InvalidInputError` where there is none.
    """
    return attach(address).camera()


class RobotSimulator:
    """Starts a simulated arm behind the real one's protocol, and ends it. A context manager.

    ``pace`` seconds on the wall are one simulated second: 1 is real time, for which server, client
    and what else runs need cores enough. The first free one of ``addresses`` is taken. ``mass`` kg
    is that of each of the ``blocks`` blocks. ``camera``: with what camera; None: without one.

    What is entered is a `SimulatedRobot`. Raises `InvalidInputError` where an argument is out of
    range, an address is taken, or what a process needs is not installed.
    """

    def __init__(
        self,
        pace: float = 1.0,
        camera: CameraSettings | None = None,
        blocks: int = 1,
        mass: float = MASS,
        addresses: Sequence[str] = ADDRESSES,
    ) -> None:
        if not (np.isfinite(pace) and 0.1 <= pace <= 100.0):
            raise InvalidInputError(f"pace must be 0.1 to 100, found {pace}")
        self._arguments = (pace, blocks, mass, camera)
        self._addresses = tuple(addresses)
        self._children: list[ChildProcess] = []

    def __enter__(self) -> SimulatedRobot:
        pace, blocks, mass, camera = self._arguments
        address = free_address(self._addresses)
        self._session = Session(address, pace, blocks, mass, os.getpid(), camera)
        self._session.create()
        folder = self._session.folder
        try:
            arm = self._started("arm_server")
            arm.wait_until(lambda: read_report(folder) is not None)
            if camera is not None:
                eye = self._started("rendered_camera", {"MUJOCO_GL": "egl"})
                eye.wait_until((folder / "newest-frame").exists)
            return SimulatedRobot(self._session)
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        for child in reversed(self._children):
            child.close()
        self._children.clear()
        self._session.remove()

    def check(self) -> None:
        """Raises `RuntimeError` where a process has died, with its last words."""
        for child in self._children:
            child.check()

    def _started(self, part: str, environment: Mapping[str, str] | None = None) -> ChildProcess:
        child = ChildProcess(f"{_PARTS}.{part}", self._session.folder, environment)
        self._children.append(child)
        return child
