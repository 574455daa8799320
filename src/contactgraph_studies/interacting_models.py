"""An interacting-multiple-model filter of holding: the classical baseline of inference.

It is given what a learned filter must find out: the exact linear models of both modes of a pair of
gripper and body, *free* and *held*, where bodies touch, and the transition matrix of the true modes
in training data. It is FilterPy's `IMMEstimator` (Blom and Bar-Shalom 1988). A mode has no memory
of its duration, so holds that end or begin after a time are beyond it.

The switching models of `dynamax` do less: their transitions depend on neither state nor control
(probml/dynamax issue 338 and pull request 452), nor on durations, and all series have as many
bodies. Geometry, by which a pair that does not touch is free, cannot be told to them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import fractional_matrix_power

from contactgraph.data import Dataset, InvalidInputError, Trajectory
from contactgraph.envs.gripper_task import GRIPPER

FREE, HELD = 0, 1
_TOUCH = 1e-4
"""Distance of surfaces up to which bodies touch, m."""
_APART = np.array([1.0 - 1e-9, 1e-9])
"""Probability of the modes of a pair that does not touch; the filter divides by it."""
_LEAST_NOISE = 1e-5
"""Of velocities, m/s."""


def touches(trajectory: Trajectory) -> np.ndarray:
    """[T + 1, N] bool, whether the gripper and a node touch by their positions."""
    radius, position = trajectory.scene.radius, trajectory.position
    if radius is None or trajectory.contact is None or trajectory.holding is None:
        raise InvalidInputError("data must have radii, contacts and holding, as those of collect")
    apart = np.linalg.norm(position - position[:, [GRIPPER]], axis=-1)
    return np.asarray(apart < radius + radius[GRIPPER] + _TOUCH)


@dataclass(frozen=True)
class PairSteps:
    """The steps of a gripper and a body, and the velocity of the body after each of them.

    In mode k it is ``gain[:, k] @ its velocity before + (1 - gain[:, k]) @ the gripper's after``: a
    free body keeps its velocity, but for what the gripper pushes it with, and a held one has the
    gripper's.
    """

    near: np.ndarray
    """[T + 1] bool, whether the two touch."""
    mode: np.ndarray
    """[T + 1] the true one."""
    velocity: np.ndarray
    """[T + 1, 2] m/s, of the body."""
    gripper: np.ndarray
    """[T + 1, 2] m/s."""
    gain: np.ndarray
    """[T, 2, 2, 2]"""

    @classmethod
    def of(cls, trajectory: Trajectory, body: int) -> "PairSteps":
        """Of a recorded pair."""
        near = touches(trajectory)[:, body]
        assert trajectory.holding is not None
        pair = [GRIPPER, body]
        position, velocity = trajectory.position[:, pair], trajectory.velocity[:, pair]
        away = position[1:, 1] - position[1:, 0]
        normal = away / np.linalg.norm(away, axis=-1, keepdims=True)
        closing = np.sum(normal * (velocity[1:, 0] - velocity[:-1, 1]), axis=-1)
        pushes = (near[1:] & (closing > 0.0))[:, None, None]
        free = np.eye(2) - pushes * normal[:, :, None] * normal[:, None, :]
        mode = np.where(trajectory.holding[:, GRIPPER, body], HELD, FREE)
        gain = np.stack([free, np.zeros_like(free)], axis=1)
        return cls(near, mode, velocity[:, 1], velocity[:, 0], gain)

    def residual(self) -> np.ndarray:
        """[T, 2, 2] m/s, of both modes."""
        before, after = self.velocity[:-1, None, :, None], self.gripper[1:, None, :, None]
        predicted = self.gain @ before + (np.eye(2) - self.gain) @ after
        return self.velocity[1:, None] - predicted[..., 0]


def pairs(trajectory: Trajectory) -> list[PairSteps]:
    """Of the gripper and each other node, in order."""
    return [PairSteps.of(trajectory, 1 + body) for body in range(trajectory.scene.node_count - 1)]


@dataclass(frozen=True)
class ModeChain:
    """The Markov chain of the modes of pairs that touch, and the noise of their models."""

    begin: np.ndarray
    """[2] probability of the modes in the first state in which a pair touches."""
    transition: np.ndarray
    """[2, 2] from the one in a state to that in the next."""
    noise: float
    """m/s, root mean square residual of the true mode."""

    @classmethod
    def counted(cls, dataset: Dataset) -> "ModeChain":
        """From the true modes of recorded trajectories, each count plus a half."""
        begin, transition = np.full(2, 0.5), np.full((2, 2), 0.5)
        squares: list[np.ndarray] = []
        for trajectory in dataset:
            for pair in pairs(trajectory):
                before, after = pair.mode[:-1], pair.mode[1:]
                stays, comes = pair.near[:-1] & pair.near[1:], ~pair.near[:-1] & pair.near[1:]
                np.add.at(transition, (before[stays], after[stays]), 1.0)
                np.add.at(begin, after[comes], 1.0)
                known = stays & (before == after)
                squares.append(pair.residual()[known, after[known]] ** 2)
        noise = float(np.sqrt(np.mean(np.concatenate(squares)))) if any(map(len, squares)) else 0.0
        transition /= transition.sum(axis=1, keepdims=True)
        return cls(begin / begin.sum(), transition, max(noise, _LEAST_NOISE))

    def transition_in(self, steps: float) -> np.ndarray:
        """[2, 2] in some steps, or in a part of one."""
        return np.asarray(fractional_matrix_power(self.transition, steps).real)

    def steps(self, near: np.ndarray) -> np.ndarray:
        """[T, 2, 2] transition of every step, by whether the pair touches: ``near`` [T + 1]."""
        touching = np.where(near[:-1, None, None], self.transition, self.begin)
        return np.where(near[1:, None, None], touching, _APART)


def held_probability(pair: PairSteps, chain: ModeChain) -> np.ndarray:
    """[T + 1] probability that the body is held in each state, by its motion up to there."""
    from filterpy.kalman import IMMEstimator, KalmanFilter  # of an extra

    filters = [KalmanFilter(dim_x=2, dim_z=2, dim_u=2) for _ in (FREE, HELD)]
    for one in filters:
        one.x, one.H = pair.velocity[0][:, None], np.eye(2)
        one.P = one.R = one.Q = chain.noise**2 * np.eye(2)
    begin = chain.begin if pair.near[0] else _APART
    transitions = chain.steps(pair.near)
    estimator = IMMEstimator(filters, begin, transitions[0])
    held = [begin[HELD]]
    for step, gains in enumerate(pair.gain):
        for one, gain in zip(filters, gains, strict=True):
            one.F, one.B = gain, np.eye(2) - gain
        estimator.predict(pair.gripper[step + 1][:, None])
        # It mixes for the next step at the end of an update.
        estimator.M = transitions[min(step + 1, len(transitions) - 1)]
        estimator.update(pair.velocity[step + 1][:, None])
        held.append(estimator.mu[HELD])
    return np.array(held)
