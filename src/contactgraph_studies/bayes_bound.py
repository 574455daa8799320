"""The error that no inference can go below on forced windows of tasks with a hidden hold.

A window is simulated by the true engine, with the hidden part drawn from its exact posterior given
the recorded states up to the window's start. The mean of these simulations has the least root mean
square error of all predictions from the past (Bayes). Run as
``python -m contactgraph_studies.bayes_bound TEST.h5 --json bound.json``.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import tyro
from tyro.conf import Positional

from contactgraph.cli.output import write_json
from contactgraph.cli.tasks import recorded_task
from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Trajectory,
    moving_bodies,
    read_trajectories,
)
from contactgraph.envs.grip import HIDDEN_OFF, HIDDEN_ON, HOLD_TIME, BreakingHold, switch
from contactgraph.envs.gripper_task import DT, GRIPPER
from contactgraph.envs.hidden_contact import HOLD_SHARE
from contactgraph.envs.planar.world import PlanarWorld
from contactgraph.evaluate import horizon_steps
from contactgraph.evaluate.forced import EVERY, Branch, branches, controls_of
from contactgraph.evaluate.statistics import moving_errors

SUBSTEPS = 10
"""Of a step; after each of them a hold may begin or end."""
SAMPLES = 12
"""Simulations of a window."""
_TOUCH = 1e-4
"""Distance of surfaces up to which bodies touch, m."""


class Posterior:
    """What is hidden in an episode, given its recorded states: by default nothing."""

    def __init__(self, trajectory: Trajectory) -> None:
        assert trajectory.contact is not None and trajectory.holding is not None
        self.contact = trajectory.contact[:, GRIPPER]
        self.held = trajectory.holding[:, GRIPPER]

    def redraw(self, world: PlanarWorld, start: int, rng: np.random.Generator | None) -> None:
        """Draws what is hidden in a ``world`` in state ``start``, given the states up to there.

        Without ``rng``: whatever is likelier than not at each time.
        """


class HoldTime(Posterior):
    """The duration of a hold, uniform from 0.5 to 2 s, given that it has lasted until now."""

    def redraw(self, world: PlanarWorld, start: int, rng: np.random.Generator | None) -> None:
        """A hold began anywhere within the step before the state in which it was first seen."""
        left = cast(BreakingHold, world.hold).left
        for node in left:
            states = int(np.argmin(self.held[start::-1, node]))
            within, beyond = (0.5, 0.5) if rng is None else rng.random(2)
            age = (states - within) * DT
            least = np.clip(age, *HOLD_TIME)
            left[node] = least + beyond * (HOLD_TIME[1] - least) - age


class Switch(Posterior):
    """The state and age of a hidden switch, by the forward recursion over both.

    It stays off, or on, for a number of substeps that is uniform between two bounds.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        super().__init__(trajectory)
        least, most = np.rint(np.array([HIDDEN_OFF, HIDDEN_ON]).T * SUBSTEPS / DT)[..., None]
        age = np.arange(most.max())
        self.hazard = np.where(age < least, 0.0, 1.0 / np.maximum(most - age, 1.0))
        """[2, A] probability to change in a substep, off and on, by the substeps since the last."""
        radius = cast(np.ndarray, trajectory.scene.radius)
        apart = np.linalg.norm(trajectory.position - trajectory.position[:, [GRIPPER]], axis=-1)
        touched = self.contact & (apart < radius + radius[GRIPPER] + _TOUCH) & ~self.held
        possible = ~np.stack([self.held.any(axis=1), touched.any(axis=1)], axis=1)
        belief = np.zeros_like(self.hazard)
        belief[:, 0] = 0.5
        self.belief = [belief]
        """[2, A] at each state: the probability to be off, or on, for so many substeps."""
        for each in possible[1:]:
            for _ in range(SUBSTEPS):
                belief = self.advanced(belief)
            belief = belief * each[:, None] / belief[each].sum()
            self.belief.append(belief)

    def advanced(self, belief: np.ndarray) -> np.ndarray:
        """The belief after a substep without an observation."""
        changes = belief * self.hazard
        after = np.roll(belief - changes, 1, axis=1)
        after[:, 0] = changes.sum(axis=1)[::-1]
        return after

    def redraw(self, world: PlanarWorld, start: int, rng: np.random.Generator | None) -> None:
        """The switch of the world is on where it likely is, or as it is drawn."""
        belief = self.belief[start]
        if rng is not None:
            drawn = rng.choice(belief.size, p=belief.ravel())
            belief = (np.arange(belief.size) == drawn).astype(float).reshape(belief.shape)

        def on() -> bool:
            nonlocal belief
            belief = self.advanced(belief)
            if rng is not None:  # one state and age again
                state = int(rng.random() < belief[1].sum())
                belief = belief * (np.arange(2) == state)[:, None] / belief[state].sum()
            return bool(belief[1].sum() > 0.5)

        world.hold = ScheduledSwitch(on)


@dataclass(eq=False)
class ScheduledSwitch:
    """A `HoldRule`: a switch whose state after each substep is told by a function."""

    on: Callable[[], bool]

    def reset(self, world: PlanarWorld) -> None:
        """Keeps no state."""

    def update(self, world: PlanarWorld, dt: float) -> None:
        """Joins or parts the gripper's pairs."""
        switch(world, self.on())


class Holders(Posterior):
    """The bodies that hold, of which those that were touched are known."""

    def __init__(self, trajectory: Trajectory) -> None:
        super().__init__(trajectory)
        names = trajectory.scene.node_name
        self.sets = np.array(list(product((False, True), repeat=len(names))))
        """[2^N, N] bool, all sets of nodes."""
        targets = self.sets[:, [name.startswith("target") for name in names]]
        possible = targets.any(axis=1) & ~targets.all(axis=1) & ~self.sets[:, GRIPPER]
        self._prior = possible * np.prod(np.where(self.sets, HOLD_SHARE, 1.0 - HOLD_SHARE), axis=1)

    def share(self, start: int) -> np.ndarray:
        """[2^N] probability of each of the `sets`."""
        touched, held = (each[: start + 1].any(axis=0) for each in (self.contact, self.held))
        share = self._prior * np.all((self.sets == held) | ~touched, axis=1)
        return np.asarray(share / share.sum())

    def redraw(self, world: PlanarWorld, start: int, rng: np.random.Generator | None) -> None:
        """A set of bodies, or all that are likelier to hold than not."""
        share = self.share(start)
        likeliest = share @ self.sets > 0.5
        holds = likeliest if rng is None else self.sets[rng.choice(len(share), p=share)]
        cast(BreakingHold, world.hold).nodes = frozenset(np.flatnonzero(holds).tolist())


POSTERIORS = {"suction": Switch, "release": HoldTime, "delay": Posterior, "sticky": Holders}
"""By the name of the task."""


def bayes_bound(dataset: Dataset, every: int = EVERY, samples: int = SAMPLES) -> dict[str, Any]:
    """`moving_errors` of the likeliest hidden part, and of the mean of ``samples`` simulations.

    Of the windows of `forced_windows`, 0.5 s long. The squared error of the mean is without what
    the number of samples adds to it, the variance of their mean. Raises `InvalidInputError` as
    `recorded_task` and `branches`, and where the data have no hidden hold.
    """
    steps = horizon_steps(dataset, None)
    rows: list[list[float]] = []
    for index, trajectory in enumerate(dataset):
        task = recorded_task(dataset, trajectory)
        name = str(trajectory.scene.metadata["task"])
        if name not in POSTERIORS or not trajectory.scene.metadata.get("hidden_switch", True):
            raise InvalidInputError(
                f"the bound is of suction --hidden-switch, release, delay and sticky, found {name}"
            )
        posterior, rng = POSTERIORS[name](trajectory), np.random.default_rng([1, index])
        rows += [
            [index, *_squared_errors(branch, posterior, steps, samples, rng)]
            for branch in branches(task, trajectory, steps, controls_of(index), every)
        ]
    episode, bodies, likeliest, mean = np.array(rows).T
    return {"windows": len(rows), "episodes": len(dataset)} | {
        f"{name}_{statistic}_m": value
        for name, squared in (("likeliest", likeliest), ("posterior_mean", mean))
        for statistic, value in moving_errors(squared, bodies, episode).items()
    }


def _squared_errors(
    branch: Branch, posterior: Posterior, steps: int, samples: int, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Of a window: the bodies that move, and the sums over them of two mean squared errors, m^2."""

    def simulated(branch: Branch) -> np.ndarray:
        return branch.trajectory(steps).position[branch.start :]

    def redrawn(rng: np.random.Generator | None) -> np.ndarray:
        other: Any = copy.deepcopy(branch)
        posterior.redraw(other.task.world, branch.start, rng)
        return simulated(other)

    likeliest, drawn = redrawn(None), np.stack([redrawn(rng) for _ in range(samples)])
    true = simulated(branch)
    moves = moving_bodies(true)
    excess = drawn.var(axis=0, ddof=1) / samples
    squared = (likeliest - true) ** 2, (drawn.mean(axis=0) - true) ** 2 - excess
    one, other = (float(each[1:].sum(axis=-1).mean(axis=0) @ moves) for each in squared)
    return float(moves.sum()), one, max(other, 0.0)


def main(
    data: Positional[Path], json: Path | None = None, every: int = EVERY, samples: int = SAMPLES
) -> None:
    """Measure the least error of predictions on forced windows of a dataset with a hidden hold.

    Args:
        data: A dataset file (HDF5) of suction --hidden-switch, release, delay or sticky.
        json: Write the numbers to this file.
        every: States from one window to the next.
        samples: Simulations of a window, of whose mean the error is measured.
    """
    found = bayes_bound(read_trajectories(data), every, samples)
    write_json(json, {"data": str(data), **found})
    print("\n".join(f"{name}: {value}" for name, value in found.items()))


if __name__ == "__main__":
    tyro.cli(main)
