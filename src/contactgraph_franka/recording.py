r"""Recording of what a control loop reads and sends, as a trajectory to train models on.

A tracker inside a loop uses past frames only, and lags. A recorded trajectory is smoothed with the
later frames too, by the Rauch-Tung-Striebel recursion over the tracker's own filter,

$$ x_k \leftarrow x_k + P_k F^T \bar P_{k+1}^{-1} (x_{k+1} - F x_k), $$

backwards over the frames, with the tracker's explanation of each (smooth motion or an impulse).
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from contactgraph.data import InvalidInputError, Scene, Trajectory
from contactgraph_franka.perception.tracker import predicted
from contactgraph_franka.safety.robot import RobotReading

if TYPE_CHECKING:
    from contactgraph_franka.perception.tracked_objects import Track

_SPARE_CYCLES = 100


class TrajectoryRecorder:
    """A `CycleCallback` of `ControlLoop` that writes into preallocated memory.

    A recording that ends by a stop is a trajectory like any other. ``N`` nodes in ``D`` dimensions.
    """

    def __init__(self, seconds: float, nodes: int, dimension: int = 3, period: float = 0.001):
        """For trajectories of up to ``seconds``, with cycles of ``period`` s.

        Raises `InvalidInputError` where they are not positive.
        """
        if not (period > 0.0 and 0.0 < seconds < math.inf):
            raise InvalidInputError(
                f"seconds and period must be positive, found {seconds} and {period}"
            )
        cycles = math.ceil(seconds / period) + _SPARE_CYCLES
        self._period = period
        each, pairs, vectors = (nodes,), (nodes, nodes), (nodes, dimension)
        read: list[tuple] = [("at", "f8"), ("position", "f8", vectors), ("velocity", "f8", vectors)]
        read += [("time", "f8", each), ("tracked", "?", each), ("contact", "f8", pairs)]
        self._read = np.empty(cycles, np.dtype(read))
        self._sent = np.empty(cycles, np.dtype([("at", "f8"), ("force", "f8", (dimension,))]))
        self.began = math.nan
        """s, on the loop's clock: the time of the first state of the last `trajectory`."""
        self.reset()

    def reset(self) -> None:
        """Discards the recording."""
        self._reads = self._sends = 0

    def __call__(self, now: float, reading: RobotReading | None, sent: np.ndarray | None) -> None:
        """Records a cycle. Readings beyond the capacity, or not finite, are left out."""
        if reading is not None and self._reads < len(self._read) and self._fits(reading):
            self._read[self._reads] = (
                now,
                reading.position,
                reading.velocity,
                reading.time,
                reading.tracked,
                np.nan if reading.contact is None else reading.contact,
            )
            self._reads += 1
        if sent is not None and self._sends < len(self._sent):
            self._sent[self._sends] = now, sent
            self._sends += 1

    def trajectory(
        self, scene: Scene, tracks: "Mapping[int, Track] | None" = None
    ) -> Trajectory | None:
        """The recording in steps of the loop's period, from the first force sent to the last.

        ``scene`` is that of the trajectory; its ``dt`` is set. ``tracks`` (`TrackedObjects`) by
        node replace objects' readings by smoothed states; other nodes' states are those read.
        Contact is recorded where it was measured throughout.
        None where there is no step. Raises `InvalidInputError` where an object was in no frame, or
        where the scene has other nodes.
        """
        nodes = self._read["time"].shape[1]
        if scene.node_count != nodes:
            raise InvalidInputError(f"the scene must have {nodes} nodes, found {scene.node_count}")
        if not (self._reads and self._sends):
            return None
        read, sent = self._read[: self._reads], self._sent[: self._sends]
        self.began = first = float(max(sent["at"][0], read["at"][0]))
        steps = round((sent["at"][-1] - first) / self._period)
        if steps < 1:
            return None
        at = first + self._period * np.arange(steps + 1)
        position, velocity = _interpolated(scene, read, at)
        for node, track in (tracks or {}).items():
            position[:, node], velocity[:, node] = smooth_track(track, at)
        # The force sent in the cycle nearest to a state acts in the step from there.
        acting = np.searchsorted(sent["at"], at[:-1] + self._period / 2.0) - 1
        last = read[np.searchsorted(read["at"], at + self._period / 2.0) - 1]
        contact = last["contact"]
        known = np.isfinite(contact[:, ~np.eye(scene.node_count, dtype=bool)]).all()
        return Trajectory(
            scene=replace(scene, dt=self._period),
            position=position,
            velocity=velocity,
            control=sent["force"][np.maximum(acting, 0)],
            contact=np.nan_to_num(contact) > 0.5 if known else None,
            tracked=last["tracked"],
            measured_at=last["time"] - first,
        )

    def _fits(self, reading: RobotReading) -> bool:
        shape = self._read["position"].shape[1:]
        values = (reading.position, reading.velocity, reading.time)
        return reading.position.shape == shape and all(np.isfinite(v).all() for v in values)


def _interpolated(scene: Scene, read: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[T+1, N, D] each, interpolated linearly between readings.

    The time stamps of actuated nodes belong to their states. Those of other nodes are the times of
    their last measurement, while their states are predicted to the time of the reading.
    """
    position = np.empty((len(at), *read["position"].shape[1:]))
    velocity = np.empty_like(position)
    for node in range(scene.node_count):
        stamps = read["time"][:, node] if scene.actuated[node] else read["at"]
        stamps, index = np.unique(stamps, return_index=True)
        for axis in range(scene.dimension):
            for name, values in (("position", position), ("velocity", velocity)):
                values[:, node, axis] = np.interp(at, stamps, read[name][index, node, axis])
    return position, velocity


def smooth_track(track: "Track", at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity, each [T, 3] m and m/s, at the times ``at`` [T] s.

    Between two frames the expected motion under white acceleration is the cubic with the frames'
    positions and velocities at its ends; before the first frame and after the last, the velocity is
    constant. All of it is relative to the hand that carried the object, whose motion is added.
    Raises `InvalidInputError` where no frame showed the object.
    """
    states = track.states
    if not states:
        raise InvalidInputError("the object was in no frame: its position is unknown")
    means = [state.mean for state in states]
    for index in reversed(range(len(states) - 1)):
        state, following = states[index], states[index + 1]
        if state.begun != following.begun:
            continue  # the filter restarted, and does not relate the two
        step = following.time - state.time
        forward = np.eye(6)
        forward[:3, 3:] = step * np.eye(3)
        predicted_covariance = predicted(state.covariance, step, following.density)
        gain = np.linalg.solve(predicted_covariance, forward @ state.covariance).T
        means[index] = state.mean + gain @ (means[index + 1] - forward @ state.mean)
    mean, times = np.stack(means), np.array([state.time for state in states])
    # Knots beyond all times, on the straight lines before the first frame and after the last.
    ends = np.array([min(at[0], times[0]) - 1.0, max(at[-1], times[-1]) + 1.0])
    straight = mean[[0, -1]]
    straight[:, :3] += (ends - times[[0, -1]])[:, None] * straight[:, 3:]
    knots = np.concatenate([ends[:1], times, ends[1:]])
    position, velocity = np.split(np.concatenate([straight[:1], mean, straight[1:]]), 2, axis=1)
    path = CubicHermiteSpline(knots, position, velocity)
    carried, speed = track.carried.motion(track.index, at)
    return path(at) + carried, path(at, 1) + speed
