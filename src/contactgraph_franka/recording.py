r"""Recording of what a control loop reads and sends, as a trajectory to train models on.

A tracker inside a loop uses past frames only, and lags. A recorded trajectory is smoothed with the
later frames too, by the Rauch-Tung-Striebel recursion over the tracker's own filter,

.. math:: x_k \leftarrow x_k + P_k F^T \bar P_{k+1}^{-1} (x_{k+1} - F x_k),

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
        self._sent_at = np.empty(cycles)
        self._sent = np.empty((cycles, dimension))
        self._read_at = np.empty(cycles)
        self._position = np.empty((cycles, nodes, dimension))
        self._velocity = np.empty((cycles, nodes, dimension))
        self._time = np.empty((cycles, nodes))
        self._tracked = np.empty((cycles, nodes), dtype=bool)
        self._contact = np.empty((cycles, nodes, nodes))
        self.began = math.nan
        """s, on the loop's clock: the time of the first state of the last `trajectory`."""
        self.reset()

    def reset(self) -> None:
        """Discards the recording."""
        self._reads = self._sends = 0

    def __call__(self, now: float, reading: RobotReading | None, sent: np.ndarray | None) -> None:
        """Records a cycle. Readings beyond the capacity, or not finite, are left out."""
        if reading is not None and self._reads < len(self._read_at) and self._fits(reading):
            index = self._reads
            self._read_at[index] = now
            self._position[index] = reading.position
            self._velocity[index] = reading.velocity
            self._time[index] = reading.time
            self._tracked[index] = reading.tracked
            self._contact[index] = np.nan if reading.contact is None else reading.contact
            self._reads += 1
        if sent is not None and self._sends < len(self._sent_at):
            self._sent_at[self._sends] = now
            self._sent[self._sends] = sent
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
        if scene.node_count != self._time.shape[1]:
            raise InvalidInputError(
                f"the scene must have {self._time.shape[1]} nodes, found {scene.node_count}"
            )
        if not (self._reads and self._sends):
            return None
        self.began = first = float(max(self._sent_at[0], self._read_at[0]))
        steps = round((self._sent_at[self._sends - 1] - first) / self._period)
        if steps < 1:
            return None
        at = first + self._period * np.arange(steps + 1)
        position, velocity = self._interpolated(scene, at)
        for node, track in (tracks or {}).items():
            position[:, node], velocity[:, node] = smooth_track(track, at)
        # The force sent in the cycle nearest to a state acts in the step from there.
        sent = np.searchsorted(self._sent_at[: self._sends], at[:-1] + self._period / 2.0) - 1
        last = np.searchsorted(self._read_at[: self._reads], at + self._period / 2.0) - 1
        contact = self._contact[last]
        known = np.isfinite(contact[:, ~np.eye(scene.node_count, dtype=bool)]).all()
        return Trajectory(
            scene=replace(scene, dt=self._period),
            position=position,
            velocity=velocity,
            control=self._sent[np.maximum(sent, 0)],
            contact=np.nan_to_num(contact) > 0.5 if known else None,
            tracked=self._tracked[last],
            measured_at=self._time[last] - first,
        )

    def _interpolated(self, scene: Scene, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[T+1, N, D] each, interpolated linearly between readings.

        The time stamps of actuated nodes belong to their states. Those of other nodes are the times
        of their last measurement, while their states are predicted to the time of the reading.
        """
        position = np.empty((len(at), *self._position.shape[1:]))
        velocity = np.empty_like(position)
        for node in range(scene.node_count):
            actuated = bool(scene.actuated[node])
            stamps = self._time[: self._reads, node] if actuated else self._read_at[: self._reads]
            stamps, index = np.unique(stamps, return_index=True)
            for axis in range(scene.dimension):
                position[:, node, axis] = np.interp(at, stamps, self._position[index, node, axis])
                velocity[:, node, axis] = np.interp(at, stamps, self._velocity[index, node, axis])
        return position, velocity

    def _fits(self, reading: RobotReading) -> bool:
        shape = self._position.shape[1:]
        values = (reading.position, reading.velocity, reading.time)
        return reading.position.shape == shape and all(np.isfinite(v).all() for v in values)


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
