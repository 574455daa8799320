r"""Where an object was, from all that a camera saw of it, before and after.

A tracker in a loop knows only the past, and lags. A recorded run knows the future too: its states
are those of the Rauch-Tung-Striebel smoother over the tracker's own filter,

.. math:: x_k \leftarrow x_k + P_k F^T \bar P_{k+1}^{-1} (x_{k+1} - F x_k),

backwards over the frames, with the tracker's explanation of each (smooth motion, or a blow).
Between two frames the expected motion under white acceleration is the cubic that has the frames'
positions and velocities at its ends. All of that is seen from what carried the object, whose motion
is known, and added.
"""

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception.tracked_objects import Track
from contactgraph_franka.perception.tracker import predicted


def smoothed(track: Track, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
