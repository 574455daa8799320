"""An interacting-multiple-model filter of holding (Blom and Bar-Shalom 1988), by FilterPy.

It is given what a learned filter must find out: the linear models of both modes of a gripper and a
body, where bodies touch, and the transition matrix of the true modes of training data. A mode does
not know how long it has lasted, so holds that begin or end after a time are beyond it.

The switching models of ``dynamax`` can be told less: their transitions depend on neither state nor
control (probml/dynamax, issue 338 and pull request 452), hence not on geometry, nor on how long a
mode has lasted, and every series has the same size, hence the same number of bodies.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import fractional_matrix_power

from contactgraph.data import Dataset, InvalidInputError, Trajectory
from contactgraph.envs.gripper_task import GRIPPER

FREE, HELD = 0, 1
TOUCH = 1e-4
"""Distance of surfaces up to which bodies touch, m."""
_NOISE = 1e-3
"""Of velocities, m/s: almost all residuals of the true mode are smaller."""
_APART = np.array([1.0 - 1e-9, 1e-9])
"""Probability of the modes of a pair that does not touch; the filter divides by it."""


def touches(trajectory: Trajectory) -> np.ndarray:
    """[T + 1, N] bool, whether the gripper and a node touch by their positions.

    Raises `InvalidInputError` where the trajectory lacks a field that the tasks record.
    """
    radius, position = trajectory.scene.radius, trajectory.position
    if radius is None or trajectory.contact is None or trajectory.holding is None:
        raise InvalidInputError("the data must have radius, contact and holding, as collect writes")
    apart = np.linalg.norm(position - position[:, [GRIPPER]], axis=-1)
    return np.asarray(apart < radius + radius[GRIPPER] + TOUCH)


def modes(trajectory: Trajectory) -> np.ndarray:
    """[T + 1, N] the true ones of the gripper and each node."""
    assert trajectory.holding is not None
    return np.where(trajectory.holding[:, GRIPPER], HELD, FREE)


def velocity_gain(trajectory: Trajectory, body: int) -> np.ndarray:
    """[T, 2, 2, 2] of the velocity of a body in both modes.

    The velocity after a step is ``gain`` times that before, plus ``1 - gain`` times the gripper's
    after it. A free body keeps its own, but for what the gripper pushes; a held one has the
    gripper's.
    """
    away = trajectory.position[1:, body] - trajectory.position[1:, GRIPPER]
    normal = away / np.linalg.norm(away, axis=-1, keepdims=True)
    closing = trajectory.velocity[1:, GRIPPER] - trajectory.velocity[:-1, body]
    pushes = touches(trajectory)[1:, body] & (np.sum(normal * closing, axis=-1) > 0.0)
    free = np.eye(2) - pushes[:, None, None] * normal[:, :, None] * normal[:, None, :]
    return np.stack([free, np.zeros_like(free)], axis=1)


@dataclass(frozen=True)
class ModeChain:
    """The Markov chain of the modes of pairs that touch."""

    begin: np.ndarray
    """[2] probability in the first state in which a pair touches."""
    transition: np.ndarray
    """[2, 2] probability of the next mode, by the present one."""

    @classmethod
    def counted(cls, dataset: Dataset) -> "ModeChain":
        """From the true modes of recorded trajectories, each count plus a half."""
        begin, transition = np.full(2, 0.5), np.full((2, 2), 0.5)
        for trajectory in dataset:
            near, mode = (each[:, 1:] for each in (touches(trajectory), modes(trajectory)))
            stays, comes = near[:-1] & near[1:], ~near[:-1] & near[1:]
            np.add.at(transition, (mode[:-1][stays], mode[1:][stays]), 1.0)
            np.add.at(begin, mode[1:][comes], 1.0)
        return cls(begin / begin.sum(), transition / transition.sum(axis=1, keepdims=True))

    def transition_in(self, steps: float) -> np.ndarray:
        """[2, 2] in some steps, or in a part of one."""
        return np.asarray(fractional_matrix_power(self.transition, steps).real)

    def transitions(self, near: np.ndarray) -> np.ndarray:
        """[T, 2, 2] of every step, by whether a pair touches in each state [T + 1]."""
        touching = np.where(near[:-1, None, None], self.transition, self.begin)
        return np.where(near[1:, None, None], touching, _APART)


def held_probability(trajectory: Trajectory, body: int, chain: ModeChain) -> np.ndarray:
    """[T + 1] that a body is held in each state, by its motion up to there."""
    from filterpy.kalman import IMMEstimator, KalmanFilter  # of an extra

    velocity, gripper = (trajectory.velocity[:, node, :, None] for node in (body, GRIPPER))
    near = touches(trajectory)[:, body]
    transitions = chain.transitions(near)
    filters = [KalmanFilter(dim_x=2, dim_z=2, dim_u=2) for _ in (FREE, HELD)]
    for one in filters:
        one.x, one.H = velocity[0], np.eye(2)
        one.P = one.Q = one.R = _NOISE**2 * np.eye(2)
    begin = chain.begin if near[0] else _APART
    estimator = IMMEstimator(filters, begin, transitions[0])
    held = [begin[HELD]]
    for step, gains in enumerate(velocity_gain(trajectory, body)):
        for one, gain in zip(filters, gains, strict=True):
            one.F, one.B = gain, np.eye(2) - gain
        estimator.predict(gripper[step + 1])
        estimator.M = transitions[min(step + 1, len(transitions) - 1)]  # an update mixes by it
        estimator.update(velocity[step + 1])
        held.append(estimator.mu[HELD])
    return np.array(held)
