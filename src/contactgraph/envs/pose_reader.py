"""Poses and velocities of bodies, read from an environment's observations by its map."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from contactgraph.data.turns import angular_velocity, rotations
from contactgraph.envs.environment_map import Entries, EnvironmentMap, MappedBody


@dataclass(frozen=True, eq=False)
class BodyState:
    """The state of all bodies at one step."""

    position: np.ndarray
    """[N, D] m."""
    velocity: np.ndarray
    """[N, D] m/s."""
    orientation: np.ndarray
    """[N, 1] rad or [N, 4] unit quaternion; [N, 0] where the map has none."""
    angular_velocity: np.ndarray
    """[N, 1 or 3] rad/s; [N, 0] where the map has none."""


def read_state(
    environment_map: EnvironmentMap, observation: Any, previous: BodyState | None
) -> BodyState:
    """The state that an observation tells; ``previous`` is the one before, None at the start.

    Angles continue without jumps, and so do the signs of quaternions. A velocity that is not given
    is the difference to ``previous`` over ``dt``.
    """
    bodies, dt = environment_map.bodies, environment_map.dt
    position = np.stack([_read_length(environment_map, b.position, observation) for b in bodies])
    for index, body in enumerate(bodies):
        if body.relative_to is not None:
            position[index] += position[environment_map.index(body.relative_to, body.name)]
    turning = _orientation(environment_map, observation, previous)
    for index, body in enumerate(bodies):
        if body.reference is not None:
            position[index] += _turned(turning[index], np.array(body.reference))
    before = position if previous is None else previous.position
    velocity = (position - before) / dt
    angular = angular_velocity(turning if previous is None else previous.orientation, turning, dt)
    for index, body in enumerate(bodies):
        if body.velocity is not None:
            velocity[index] = body.velocity.read(observation) * environment_map.scale
        if body.angular_velocity is not None:
            angular[index] = body.angular_velocity.read(observation)
    for index, body in enumerate(bodies):
        if body.velocity is not None and body.relative_to is not None:
            velocity[index] += velocity[environment_map.index(body.relative_to, body.name)]
    return BodyState(position, velocity, turning, angular)


def _read_length(environment_map: EnvironmentMap, entries: Entries, observation: Any) -> np.ndarray:
    return environment_map.scale * entries.read(observation)


def _orientation(
    environment_map: EnvironmentMap, observation: Any, previous: BodyState | None
) -> np.ndarray:
    if not environment_map.turns:
        return np.zeros((len(environment_map.bodies), 0))
    orientation = np.stack([_pose(body, observation) for body in environment_map.bodies])
    if previous is None:
        return orientation
    if orientation.shape[1] == 1:
        turn = orientation - previous.orientation
        return previous.orientation + (turn + np.pi) % (2.0 * np.pi) - np.pi
    agree = np.sum(orientation * previous.orientation, axis=1, keepdims=True) >= 0.0
    return np.where(agree, orientation, -orientation)


def _pose(body: MappedBody, observation: Any) -> np.ndarray:
    """The body's angle ``[1]`` or unit quaternion ``[4]``."""
    entries = body.orientation
    read = entries.read(observation) if isinstance(entries, Entries) else np.array(entries)
    if body.euler:
        from scipy.spatial.transform import Rotation

        return np.roll(Rotation.from_euler(body.euler, read).as_quat(), 1)
    return read if read.size == 1 else read / np.linalg.norm(read)


def _turned(orientation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A vector ``[D]`` of the body's frame in world axes."""
    if orientation.size == 4:
        return rotations(orientation).apply(vector)
    cosine, sine = np.cos(orientation[0]), np.sin(orientation[0])
    return np.array([[cosine, -sine], [sine, cosine]]) @ vector
