"""Memory that the simulated robot's processes share: ground truth and scene resets."""

import fcntl
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph_franka.shared_ring import RingReader, RingWriter, create_shared, open_shared

_KEPT = 1 << 15
"""Control steps kept: 32 simulated seconds, so that an episode can be read when it is over."""
_REQUEST = np.dtype(
    [("asked", "i8"), ("done", "i8"), ("block", "i8"), ("position", "f8", (3,)), ("yaw", "f8")]
)
_TIMEOUT = 5.0  # Wall time to wait for a scene reset, s


def ground_truth_fields(blocks: int, nq: int) -> list[tuple]:
    """The fields of a control step, for ``blocks`` blocks and a ``qpos`` of ``nq`` numbers.

    Nodes are the hand's grasp point and the blocks. Positions are in the frame of the arm's base.
    """
    return [
        ("time", "f8"),  # s, simulated since the start
        ("stamp", "f8"),  # s, on the reader's clock
        ("position", "f8", (1 + blocks, 3)),  # m
        ("velocity", "f8", (1 + blocks, 3)),  # m/s
        ("turn", "f8", (1 + blocks, 4)),  # unit quaternions, the real part first
        ("fingers", "?", (blocks, 2)),  # whether the left, the right finger touches
        ("standing", "?", (blocks,)),  # whether it touches the table
        ("width", "f8"),  # m between the fingers
        ("qpos", "f8", (nq,)),  # of MuJoCo, for a renderer
    ]


def create_ground_truth(folder: Path, blocks: int, nq: int) -> RingWriter:
    """The ring of control steps; the number of a record is that of its step, from 0."""
    return RingWriter(folder / "truth", ground_truth_fields(blocks, nq), _KEPT)


class GroundTruth:
    """The control steps of a simulation, from any process."""

    def __init__(self, folder: Path) -> None:
        self._ring = RingReader(folder / "truth")

    def newest(self) -> np.void:
        """The newest step, with the fields of `ground_truth_fields` and its ``number``."""
        return self._ring.newest()

    def since(self, number: int) -> np.ndarray:
        """[K]: the kept steps after ``number``, in order."""
        return self._ring.last(number + 1)

    def between(self, begin: float, end: float) -> np.ndarray:
        """[K]: the kept steps with stamps from ``begin`` to ``end`` s on the reader's clock."""
        rows = self.since(-1)
        return rows[(rows["stamp"] >= begin) & (rows["stamp"] <= end)]

    @property
    def rate(self) -> float:
        """Mean of the kept steps a second of the reader's clock; 1000 if on time."""
        rows = self.since(-1)
        steps, seconds = (rows[name][-1] - rows[name][0] for name in ("number", "stamp"))
        return float(steps / max(seconds, 1e-9))


def ground_truth_trajectory(truth: GroundTruth, recorded: Trajectory, began: float) -> Trajectory:
    """``recorded`` with true positions, velocities and contacts.

    ``began`` s on the reader's clock is the time of its first state. A block touches the hand if a
    finger touches it. Raises `InvalidInputError` if the ground truth is no longer kept.
    """
    at = began + recorded.scene.dt * np.arange(recorded.steps + 1)
    rows = truth.between(at[0] - 0.1, at[-1] + 0.1)
    if not len(rows) or rows["stamp"][0] > at[0]:
        raise InvalidInputError(f"the truth of {at[0]:.3f} s on is no longer kept")
    # Extrapolation from the last step before each state errs by less than 0.01 mm.
    index = np.maximum(np.searchsorted(rows["stamp"], at, side="right") - 1, 0)
    late = (at - rows["stamp"][index])[:, None, None]
    velocity = rows["velocity"][index]
    nodes = recorded.scene.node_count
    contact = np.zeros((len(at), nodes, nodes), bool)
    contact[:, 0, 1:] = contact[:, 1:, 0] = rows["fingers"][index].any(axis=2)
    return replace(
        recorded,
        position=rows["position"][index] + late * velocity,
        velocity=velocity,
        contact=contact,
        tracked=None,
        measured_at=None,
    )


class SceneResetService:
    """The server's end of scene resets: another process asks for a block to be moved."""

    def __init__(self, folder: Path) -> None:
        self._request = create_shared(folder / "orders", _REQUEST, 1)
        self._done = 0

    def execute(self, place: Callable[[int, np.ndarray, float], None]) -> None:
        """Calls ``place(block, position, yaw)`` if there is a request since the last call."""
        asked = int(self._request["asked"][0])
        if asked != self._done:
            request = self._request[0]
            place(int(request["block"]), request["position"].copy(), float(request["yaw"]))
            self._done = asked
            self._request["done"] = asked


def request_block_pose(folder: Path, block: int, position: np.ndarray, yaw: float) -> None:
    """Moves ``block`` to ``position`` [3] m and ``yaw`` rad, and waits until it is there.

    Raises `RuntimeError` if the server does not do so.
    """
    request = open_shared(folder / "orders", "r+")
    with (folder / "orders.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        asked = int(request["asked"][0]) + 1
        request["block"], request["position"], request["yaw"] = block, position, yaw
        request["asked"] = asked
        until = time.monotonic() + _TIMEOUT
        while int(request["done"][0]) != asked:
            if time.monotonic() > until:
                raise RuntimeError("the simulated robot did not put the block there in 5 s")
            time.sleep(0.001)
