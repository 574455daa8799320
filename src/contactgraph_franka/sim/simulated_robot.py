"""Starting a simulated robot, and attaching to one from other processes."""

import os
from collections.abc import Sequence
from multiprocessing.connection import Connection

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop.realtime import WallClock
from contactgraph_franka.loop.worker_process import WorkerProcess
from contactgraph_franka.perception.calibration import CameraCalibration
from contactgraph_franka.perception.camera import pose, rotation_of
from contactgraph_franka.sim.blocks import MASS, tagged_objects
from contactgraph_franka.sim.camera import CameraSettings, SimulatedCamera
from contactgraph_franka.sim.session import Session, find_session, free_address
from contactgraph_franka.sim.shared_state import GroundTruth, request_block_pose

ADDRESSES = tuple(f"127.0.0.{number}" for number in range(1, 10))
"""Addresses of a simulated robot; it takes the first free one."""
_START_S = 30.0  # Largest time of a process to be ready, s


class SimulatedRobot:
    """A running simulated robot, from any process; see `attach`."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.address = session.address
        """Address of the server, for the arm's client."""
        self.clock = WallClock(session.pace)
        """The reader's clock, slower than the wall clock by the pace, of all time stamps."""
        self.ground_truth = GroundTruth(session.folder)
        """Exact states, for evaluation and never for control."""

    @property
    def rate(self) -> float:
        """Control steps a second of wall time; 1000 over the pace if on time."""
        return self.ground_truth.rate / self.clock.pace

    def place_block(self, index: int, position: np.ndarray, yaw: float = 0.0) -> None:
        """Moves block ``index`` to ``position`` [3] m and ``yaw`` rad, at rest.

        Raises `InvalidInputError` for an impossible block or pose.
        """
        point = np.asarray(position, dtype=np.float64)
        if not 0 <= index < self._session.blocks:
            raise InvalidInputError(f"block must be 0 to {self._session.blocks - 1}, found {index}")
        if point.shape != (3,) or not np.isfinite([*point, yaw]).all():
            raise InvalidInputError(f"position must be [3] m, and yaw rad, found {position}, {yaw}")
        request_block_pose(self._session.folder, index, point, yaw)

    def camera(self) -> SimulatedCamera:
        """The camera; raises `InvalidInputError` if there is none."""
        return SimulatedCamera(self._session.folder, self._settings().intrinsics)

    def calibration(
        self, shift: Sequence[float] = (0.0, 0.0, 0.0), turn: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> CameraCalibration:
        """The calibration of the camera and the blocks' tags, exact or with a given error.

        ``shift`` [3] m is the error of the camera's position, ``turn`` [3] rad the rotation vector
        of that of its orientation, in the frame of the arm's base. Raises `InvalidInputError` if
        there is no camera.
        """
        settings = self._settings()
        camera_pose = pose(
            rotation_of(np.asarray(turn)) @ settings.pose[:3, :3],
            settings.pose[:3, 3] + np.asarray(shift),
        )
        objects = tagged_objects(self._session.blocks)
        return CameraCalibration(settings.intrinsics, camera_pose, objects)

    def _settings(self) -> CameraSettings:
        if self._session.camera is None:
            raise InvalidInputError(f"the simulated robot at {self.address} has no camera")
        return self._session.camera


def attach(address: str) -> SimulatedRobot:
    """The simulated robot at ``address``; raises `InvalidInputError` if there is none."""
    return SimulatedRobot(find_session(address))


def open_camera(address: str) -> SimulatedCamera:
    """The camera of the simulated robot at ``address``; raises `InvalidInputError` if none."""
    return attach(address).camera()


class RobotSimulator:
    """Starts a simulated arm behind the real one's protocol, and ends it. A context manager.

    ``pace`` is the wall time of a simulated second; 1, real time, needs enough cores for server
    and client. The server takes the first free one of ``addresses``. ``mass`` kg is that of each
    of the ``blocks`` blocks. ``camera``: settings of its camera; None: no camera.

    Entering it returns a `SimulatedRobot`. Raises `InvalidInputError` if an argument is out of
    range, no address is free, or a process lacks a package.
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
        self._arguments = (pace, blocks, mass)
        self._camera = camera
        self._addresses = tuple(addresses)
        self._workers: list[WorkerProcess] = []

    def __enter__(self) -> SimulatedRobot:
        address = free_address(self._addresses)
        self._session = Session(address, *self._arguments, os.getpid(), self._camera)
        self._session.create()
        try:
            self._wait_for(WorkerProcess("the simulated arm", _serve_arm, self._session))
            if self._camera is not None:
                arguments = self._session, self._camera
                self._wait_for(WorkerProcess("the rendered camera", _render, *arguments, nice=5))
            return SimulatedRobot(self._session)
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        for worker in reversed(self._workers):
            worker.close()
        self._workers.clear()
        self._session.remove()

    def check(self) -> None:
        """Raises the error of a process that has ended; see `WorkerProcess.receive`."""
        for worker in self._workers:
            worker.check()

    def _wait_for(self, worker: WorkerProcess) -> None:
        self._workers.append(worker)
        worker.receive(_START_S)


def _serve_arm(connection: Connection, session: Session) -> None:
    from contactgraph_franka.sim.arm_server import serve

    serve(connection, session)


def _render(connection: Connection, session: Session, settings: CameraSettings) -> None:
    os.environ["MUJOCO_GL"] = "egl"  # MuJoCo reads it when it is imported
    from contactgraph_franka.sim.rendered_camera import render

    render(connection, session, settings)
