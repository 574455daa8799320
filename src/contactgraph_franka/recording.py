"""Writes down what a loop reads and sends, and makes a run of it."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from contactgraph.data import InvalidInputError, Scene, Trajectory
from contactgraph_franka.perception.tracked_objects import Track
from contactgraph_franka.perception.tracker import predicted
from contactgraph_franka.safety.robot import RobotReading

_SPARE_TICKS = 100


class TrajectoryRecorder:
    """An `OnTick` of `ControlLoop`: nothing is computed and no memory taken while it runs.

    What was recorded before a stop is a run like any other. ``N`` nodes in ``D`` dimensions.
    """

    def __init__(self, seconds: float, nodes: int, dimension: int = 3, period: float = 0.001):
        """For runs of up to ``seconds``, of ticks every ``period`` s.

        Raises `InvalidInputError` where they are not positive.
        """
        if not (period > 0.0 and 0.0 < seconds < math.inf):
            raise InvalidInputError(
                f"seconds and period must be positive, found {seconds} and {period}"
            )
        ticks = math.ceil(seconds / period) + _SPARE_TICKS
        self._period = period
        self._sent_at = np.empty(ticks)
        self._sent = np.empty((ticks, dimension))
        self._read_at = np.empty(ticks)
        self._position = np.empty((ticks, nodes, dimension))
        self._velocity = np.empty((ticks, nodes, dimension))
        self._time = np.empty((ticks, nodes))
        self._tracked = np.empty((ticks, nodes), dtype=bool)
        self._contact = np.empty((ticks, nodes, nodes))
        self.began = math.nan
        """s, on the loop's clock: when the first state of the last `run` was."""
        self.begin()

    def begin(self) -> None:
        """Forgets everything: a new run."""
        self._reads = self._sends = 0

    def __call__(self, now: float, reading: RobotReading | None, sent: np.ndarray | None) -> None:
        """Takes in a tick. What does not fit in any more, or is not finite, is left out."""
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

    def run(self, scene: Scene, tracks: Mapping[int, Track] | None = None) -> Trajectory | None:
        """The run, in steps of the loop's period, from the first force sent to the last.

        ``scene`` is that of the run; its ``dt`` is set. ``tracks`` are those of objects by
        their nodes (`TrackedObjects`): where they were is smoothed from that; states of other nodes
        are as they were read. Contact is recorded where it was measured throughout.
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
        position, velocity = self._as_read(scene, at)
        for node, track in (tracks or {}).items():
            position[:, node], velocity[:, node] = smooth_track(track, at)
        # The tick nearest to each state: its force acts in the step from there.
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

    def _as_read(self, scene: Scene, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[T+1, N, D] each, between readings on the straight line.

        The stamps of what is driven say when it was there; those of other nodes, when they were
        last measured, but their states are those at the time of the reading.
        """
        position = np.empty((len(at), *self._position.shape[1:]))
        velocity = np.empty_like(position)
        for node in range(scene.node_count):
            driven = bool(scene.actuated[node])
            stamps = self._time[: self._reads, node] if driven else self._read_at[: self._reads]
            stamps, index = np.unique(stamps, return_index=True)
            for axis in range(scene.dimension):
                position[:, node, axis] = np.interp(at, stamps, self._position[index, node, axis])
                velocity[:, node, axis] = np.interp(at, stamps, self._velocity[index, node, axis])
        return position, velocity

    def _fits(self, reading: RobotReading) -> bool:
        shape = self._position.shape[1:]
        values = (reading.position, reading.velocity, reading.time)
        return reading.position.shape == shape and all(np.isfinite(v).all() for v in values)


def smooth_track(track: Track, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity, each [T, 3] m and m/s, at the times ``at`` [T] s.

    Before the first frame that counted, and after the last, the object goes on as it did there.
    Raises `InvalidInputError` where there was none.
    """
    states = track.states
    if not states:
        raise InvalidInputError("the object was in no frame: it cannot be said where it was")
    means = [state.mean for state in states]
    for index in reversed(range(len(states) - 1)):
        here, after = states[index], states[index + 1]
        if here.begun != after.begun:
            continue  # the filter lost it in between, and says nothing of how it got there
        step = after.time - here.time
        forward = np.eye(6)
        forward[:3, 3:] = step * np.eye(3)
        ahead = predicted(here.covariance, step, after.density)
        gain = np.linalg.solve(ahead, forward @ here.covariance).T
        means[index] = here.mean + gain @ (means[index + 1] - forward @ here.mean)
    position, velocity = _between(np.array([state.time for state in states]), np.stack(means), at)
    moved, speed = track.carried.motion(track.index, at)
    return position + moved, velocity + speed


def _between(frame: np.ndarray, mean: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cubics between ``mean`` [K, 6] at ``frame`` [K] s, and straight on outside of them."""
    inside = np.clip(at, frame[0], frame[-1])
    index = np.clip(np.searchsorted(frame, inside, side="right") - 1, 0, max(0, len(frame) - 2))
    after = np.minimum(index + 1, len(frame) - 1)
    step = (frame[after] - frame[index])[:, None]
    step = np.where(step > 0.0, step, 1.0)
    s = (inside - frame[index])[:, None] / step
    p, v = mean[index, :3], mean[index, 3:] * step
    q, w = mean[after, :3], mean[after, 3:] * step
    way = q - p
    position = p + s * v + s**2 * (3.0 * way - 2.0 * v - w) + s**3 * (v + w - 2.0 * way)
    velocity = v + 2.0 * s * (3.0 * way - 2.0 * v - w) + 3.0 * s**2 * (v + w - 2.0 * way)
    velocity = velocity / step
    return position + (at - inside)[:, None] * velocity, velocity
