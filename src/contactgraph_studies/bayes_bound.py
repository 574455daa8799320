"""The error that no inference can go below on forced windows of tasks with a hidden hold.

A window is simulated by the true engine, with the hidden part drawn from its exact posterior given
the recorded states up to the window's start; commands are interventions and tell nothing. The mean
of these simulations has the least root mean square error of all predictions from the past (Bayes).
Beside it stands, in the same engine, what takes all that touches for held, or for free. Run as
``python -m contactgraph_studies.bayes_bound TEST.h5``; ``benchmarks/interacting_models.py`` adds
a classical filter and a trained model.
"""

import copy
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import tyro
from tyro.conf import Positional

from contactgraph.cli.options import check_range
from contactgraph.cli.output import check_writable, write_json
from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Trajectory,
    moving_bodies,
    read_trajectories,
)
from contactgraph.envs.grip import HIDDEN_OFF, HIDDEN_ON, HOLD_TIME, BreakingHold, touched
from contactgraph.envs.gripper_task import DT, GRIPPER
from contactgraph.envs.hidden_contact import HOLD_SHARE
from contactgraph.envs.planar.world import PlanarWorld
from contactgraph.evaluate import horizon_steps
from contactgraph.evaluate.forced import EVERY, Branch, branches, recorded_task
from contactgraph.evaluate.statistics import moving_errors
from contactgraph.viz.metric_table import short
from contactgraph_studies.tables import StudyTable

SUBSTEPS = 10
"""Of a step; after each of them a hold may begin or end."""
SAMPLES = 12
"""Simulations of a window."""
_TOUCH = 1e-4
"""Distance of surfaces up to which bodies touch, m."""


def touches(trajectory: Trajectory) -> np.ndarray:
    """[T + 1, N] bool, whether the gripper and a node touch by their positions.

    Raises `InvalidInputError` where the trajectory lacks a field that the tasks record.
    """
    radius, position = trajectory.scene.radius, trajectory.position
    if radius is None or trajectory.contact is None or trajectory.holding is None:
        raise InvalidInputError("the data must have radius, contact and holding, as collect writes")
    apart = np.linalg.norm(position - position[:, [GRIPPER]], axis=-1)
    return np.asarray(apart < radius + radius[GRIPPER] + _TOUCH)


class Posterior:
    """What is hidden in an episode, given its recorded states: by default nothing."""

    draws = False
    """Whether anything is drawn."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.near = touches(trajectory)
        assert trajectory.contact is not None and trajectory.holding is not None
        self.contact = trajectory.contact[:, GRIPPER]
        self.held = trajectory.holding[:, GRIPPER]

    def redraw(self, world: PlanarWorld, start: int, rng: np.random.Generator | None) -> None:
        """Draws what is hidden in a ``world`` in state ``start``, given the states up to there.

        Without ``rng``: whatever is likelier than not at each time.
        """


class HoldTime(Posterior):
    """The duration of a hold, uniform from 0.5 to 2 s, given that it has lasted until now."""

    draws = True

    def redraw(self, world: PlanarWorld, start: int, rng: np.random.Generator | None) -> None:
        """A hold began anywhere within the step before the state in which it was first seen."""
        left = cast(BreakingHold, world.hold).left
        for node in left:
            states = int(np.argmin(self.held[start::-1, node]))
            within, beyond = (0.5, 0.5) if rng is None else rng.random(2)
            age = (states - within) * DT
            least = np.clip(age, *HOLD_TIME)
            left[node] = least + beyond * (HOLD_TIME[1] - least) - age


@dataclass(eq=False)
class GivenHold:
    """A `HoldRule`: of the nodes that the gripper touches after a substep it holds those given."""

    given: Callable[[set[int]], set[int]]

    def update(self, world: PlanarWorld, dt: float) -> None:
        """Joins or parts the gripper's pairs."""
        near = touched(world)
        held = self.given(near)
        for node in sorted(near):
            change = world.join if node in held else world.part
            change(GRIPPER, node)


class Switch(Posterior):
    """The state and age of a hidden switch, by the forward recursion over both.

    It stays off, or on, for a number of substeps that is uniform between two bounds.
    """

    draws = True

    def __init__(self, trajectory: Trajectory) -> None:
        super().__init__(trajectory)
        least, most = np.rint(np.array([HIDDEN_OFF, HIDDEN_ON]).T * SUBSTEPS / DT)[..., None]
        age = np.arange(most.max())
        self.hazard = np.where(age < least, 0.0, 1.0 / np.maximum(most - age, 1.0))
        """[2, A] probability to change in a substep, off and on, by the substeps since the last."""
        touched = self.contact & self.near & ~self.held
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

        def given(near: set[int]) -> set[int]:
            nonlocal belief
            belief = self.advanced(belief)
            if rng is not None:  # one state and age again
                state = int(rng.random() < belief[1].sum())
                belief = belief * (np.arange(2) == state)[:, None] / belief[state].sum()
            return near if belief[1].sum() > 0.5 else set()

        world.hold = GivenHold(given)


class Holders(Posterior):
    """The bodies that hold, of which those that were touched are known."""

    draws = True

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


class Assumed(Posterior):
    """What the gripper touches is held, or free: the geometric prior in the place of inference."""

    def __init__(self, trajectory: Trajectory, holds: bool) -> None:
        super().__init__(trajectory)
        self._holds = holds

    def redraw(self, world: PlanarWorld, start: int, rng: np.random.Generator | None) -> None:
        """The same in every state."""
        hold_given(world, lambda near: near if self._holds else set())


def hold_given(world: PlanarWorld, given: Callable[[set[int]], set[int]]) -> None:
    """The gripper holds what is given, before the next substep already."""
    world.hold = GivenHold(given)
    world.hold.update(world, 0.0)


def posteriors(trajectory: Trajectory) -> dict[str, Posterior]:
    """By name, of a recorded episode: the exact one, and what needs no inference.

    Raises `InvalidInputError` where there is no hidden hold.
    """
    metadata = trajectory.scene.metadata
    name = str(metadata.get("task"))
    if name not in POSTERIORS or not metadata.get("hidden_switch", True):
        raise InvalidInputError(
            f"the bound is of suction --hidden-switch, release, delay and sticky, found {name}"
        )
    return {
        "Bayes": POSTERIORS[name](trajectory),
        "prior-hold": Assumed(trajectory, holds=True),
        "prior-touch": Assumed(trajectory, holds=False),
    }


def bayes_bound(
    dataset: Dataset,
    every: int = EVERY,
    samples: int = SAMPLES,
    compared: Callable[[Trajectory], Mapping[str, Posterior]] = posteriors,
) -> dict[str, Any]:
    """`moving_errors` of predictions of the windows of `forced_windows`, 0.5 s long.

    A prediction is a simulation of the likeliest hidden part, or the mean of ``samples``. Raises
    `InvalidInputError` as `recorded_task`, `branches` and ``compared``.
    """
    steps = horizon_steps(dataset, None)
    windows: list[dict[str, float]] = []
    for index, trajectory in enumerate(dataset):
        beliefs, task = compared(trajectory), recorded_task(dataset, trajectory)
        for branch in branches(task, trajectory, steps, index, every):
            rng = np.random.default_rng([1, index, branch.start])
            windows.append({"episode": index} | _errors(branch, beliefs, steps, samples, rng))
    columns = {name: np.array([each[name] for each in windows]) for name in windows[0]}
    episode, bodies = columns.pop("episode"), columns.pop("bodies")
    return {
        "windows": len(windows),
        "episodes": len(dataset),
        "errors_m": {name: moving_errors(each, bodies, episode) for name, each in columns.items()},
    }


def _errors(
    branch: Branch,
    beliefs: Mapping[str, Posterior],
    steps: int,
    samples: int,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Of a window: the bodies that move, and the sums over them of mean squared errors, m^2.

    That of a mean of samples is without what their number adds, the variance of their mean.
    """

    def simulated(posterior: Posterior | None, rng: np.random.Generator | None) -> np.ndarray:
        other: Any = copy.deepcopy(branch)
        if posterior is not None:
            posterior.redraw(other.task.world, branch.start, rng)
        return np.asarray(other.trajectory(steps).position[branch.start :])

    true = simulated(None, None)
    moves = moving_bodies(true)

    def summed(squared: np.ndarray) -> float:
        return max(float(squared[1:].sum(axis=-1).mean(axis=0) @ moves), 0.0)

    found = {"bodies": float(moves.sum())}
    for name, posterior in beliefs.items():
        found[name] = summed((simulated(posterior, None) - true) ** 2)
        if posterior.draws:
            drawn = np.stack([simulated(posterior, rng) for _ in range(samples)])
            excess = drawn.var(axis=0, ddof=1) / samples
            found[f"{name}, mean"] = summed((drawn.mean(axis=0) - true) ** 2 - excess)
    return found


def error_table(errors: Mapping[str, Mapping[str, Any]]) -> StudyTable:
    """Of the predictions of `bayes_bound`, cm."""
    headings = {"rmse": "RMSE, cm (95 %)", "mean": "mean of the windows' errors, cm (95 %)"}
    rows = []
    for prediction, values in errors.items():
        row = {"prediction": prediction}
        for name in headings:
            each = (values[name], *values[f"{name}_interval"])
            value, low, high = (short(100.0 * number) for number in each)
            row[name] = f"{value} ({low} to {high})"
        rows.append(row)
    return StudyTable("Forced windows", "", {"prediction": "prediction"} | headings, rows)


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
    check_writable(json)
    check_range("--every", every, 1, 100_000)
    check_range("--samples", samples, 2, 100_000)
    found = bayes_bound(read_trajectories(data), every, samples)
    write_json(json, {"data": str(data), **found})
    print(f"{data}: {found['windows']} windows of {found['episodes']} episodes")
    print(error_table(found["errors_m"]).markdown())


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except InvalidInputError as error:
        print(f"bayes_bound: {error}", file=sys.stderr)
        sys.exit(2)
