"""An interacting-multiple-model filter of holding (Blom and Bar-Shalom 1988), by FilterPy.

It predicts the forced windows of `contactgraph_studies.bayes_bound`, beside the bound and, with
``--model``, a trained model:

    python benchmarks/interacting_models.py TEST.h5 TRAIN.h5 --model RUN

It is given what a learned filter must find out: the linear models of both modes of a gripper and a
body, where bodies touch, and the transition matrix of the true modes of the training data; from a
window's start on, the Markov chain decides in the true engine. A mode does not know how long it has
lasted, so holds that begin or end after a time are beyond it.

The switching models of ``dynamax`` can be told less: their transitions depend on neither state nor
control (probml/dynamax, issue 338 and pull request 452), hence not on geometry, nor on how long a
mode has lasted, and every series has the same size, hence the same number of bodies.
"""

import argparse
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter
from scipy.linalg import fractional_matrix_power

from contactgraph.cli.models import in_steps_of, motion_evidence, stored_model
from contactgraph.cli.output import check_writable, write_json
from contactgraph.data import Dataset, InvalidInputError, Trajectory, read_trajectories
from contactgraph.envs.gripper_task import GRIPPER
from contactgraph.envs.planar.world import PlanarWorld
from contactgraph.evaluate import evaluate_open_loop, forced_windows, horizon_steps
from contactgraph.evaluate.forced import recorded_task
from contactgraph_studies.bayes_bound import (
    SUBSTEPS,
    Posterior,
    bayes_bound,
    error_table,
    hold_given,
    posteriors,
    touches,
)

FREE, HELD = 0, 1
_NOISE = 1e-3
"""Of velocities, m/s: almost all residuals of the true mode are smaller."""
_APART = np.array([1.0 - 1e-9, 1e-9])
"""Probability of the modes of a pair that does not touch; the filter divides by it."""


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


class InteractingModels(Posterior):
    """The modes of pairs by the filter up to a state, and by the Markov chain from there on."""

    draws = True

    def __init__(self, trajectory: Trajectory, chain: ModeChain) -> None:
        super().__init__(trajectory)
        self._begin, self._transition = chain.begin, chain.transition_in(1.0 / SUBSTEPS)
        nodes = range(1, trajectory.scene.node_count)
        self.held_probability = {node: held_probability(trajectory, node, chain) for node in nodes}
        """[T + 1] by node."""

    def redraw(self, world: PlanarWorld, start: int, rng: np.random.Generator | None) -> None:
        """The gripper holds what it likely does, or as it is drawn after each substep."""
        held = {node: each[start] for node, each in self.held_probability.items()}

        def given(near: set[int]) -> set[int]:
            nonlocal held
            held = {
                node: self._transition[:, HELD] @ (1.0 - held[node], held[node])
                if node in held
                else self._begin[HELD]
                for node in sorted(near)
            }
            if rng is not None:
                held = {node: float(rng.random() < share) for node, share in held.items()}
            return {node for node, share in held.items() if share > 0.5}

        hold_given(world, given)


def model_errors(name: str, dataset: Dataset) -> dict[str, Any]:
    """Of a trained model in the same windows, which corrects its beliefs by motion."""
    model = stored_model(name)
    dataset = in_steps_of(model, dataset, "the data")
    steps = horizon_steps(dataset, None)
    windows, episodes = forced_windows(dataset, partial(recorded_task, dataset), steps)
    noise = motion_evidence(model, asked=True, ignored=False)
    metrics = evaluate_open_loop(model, windows, motion_noise=noise, last_window_of=episodes)
    values = metrics.to_json()
    ends = ("rmse", "rmse_interval", "mean", "mean_interval")
    return {end: values[f"n_step_{end}_moving_inferred_m"] for end in ends}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("train", type=Path)
    parser.add_argument("--model")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    check_writable(given.json)
    dataset = read_trajectories(given.data)
    chain = ModeChain.counted(read_trajectories(given.train))

    def compared(trajectory: Trajectory) -> dict[str, Posterior]:
        return posteriors(trajectory) | {"IMM": InteractingModels(trajectory, chain)}

    trained = {} if given.model is None else {given.model: model_errors(given.model, dataset)}
    found = bayes_bound(dataset, compared=compared)
    found["errors_m"] |= trained
    write_json(given.json, {"data": str(given.data), **found})
    print(f"{given.data}: {found['windows']} windows of {found['episodes']} episodes")
    print(error_table(found["errors_m"]).markdown())


if __name__ == "__main__":
    try:
        main()
    except InvalidInputError as error:
        print(f"interacting_models: {error}", file=sys.stderr)
        sys.exit(2)
