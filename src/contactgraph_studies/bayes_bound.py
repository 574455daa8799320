"""The error that no inference can go below on forced windows of tasks with a hidden hold.

A window is simulated by the true engine, with the hidden part drawn from its exact posterior given
the recorded states up to the window's start; commands are interventions and tell nothing. The mean
of these simulations has the least root mean square error of all predictions from the past (Bayes).
Beside it stand, in the same engine, a filter of interacting models, and what takes all that touches
for held, or for free. Run as ``python -m contactgraph_studies.bayes_bound TEST.h5 --train
TRAIN.h5``.
"""

import copy
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import tyro
from tyro.conf import Positional

from contactgraph.cli.models import in_steps_of, motion_evidence, stored_model
from contactgraph.cli.options import check_range
from contactgraph.cli.output import check_writable, write_json
from contactgraph.cli.tasks import recorded_task
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
from contactgraph.evaluate import evaluate_open_loop, forced_windows, horizon_steps
from contactgraph.evaluate.forced import EVERY, Branch, branches, controls_of
from contactgraph.evaluate.statistics import moving_errors
from contactgraph.viz.metric_table import short
from contactgraph_studies.interacting_models import (
    HELD,
    ModeChain,
    held_probability,
    pairs,
    touches,
)
from contactgraph_studies.tables import StudyTable

SUBSTEPS = 10
"""Of a step; after each of them a hold may begin or end."""
SAMPLES = 12
"""Simulations of a window."""


class Posterior:
    """What is hidden in an episode, given its recorded states: by default nothing."""

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

    def reset(self, world: PlanarWorld) -> None:
        """Keeps no state."""

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


class InteractingModels(Posterior):
    """The modes of pairs by the filter up to a state, and by the Markov chain from there on."""

    def __init__(self, trajectory: Trajectory, chain: ModeChain) -> None:
        super().__init__(trajectory)
        self._chain = chain
        self._held = [held_probability(pair, chain) for pair in pairs(trajectory)]

    def redraw(self, world: PlanarWorld, start: int, rng: np.random.Generator | None) -> None:
        """The gripper holds what it likely does, or as it is drawn after each substep."""
        transition = self._chain.transition_in(1.0 / SUBSTEPS)
        held = {1 + index: each[start] for index, each in enumerate(self._held)}

        def given(near: set[int]) -> set[int]:
            nonlocal held
            held = {
                node: transition[:, HELD] @ (1.0 - held[node], held[node])
                if node in held
                else self._chain.begin[HELD]
                for node in sorted(near)
            }
            if rng is not None:
                held = {node: float(rng.random() < share) for node, share in held.items()}
            return {node for node, share in held.items() if share > 0.5}

        _give(world, given)


class Assumed(Posterior):
    """All that the gripper touches is held, or free: the geometric prior in the place of inference.

    ``holds`` says which.
    """

    def __init__(self, trajectory: Trajectory, holds: bool) -> None:
        super().__init__(trajectory)
        self._holds = holds

    def redraw(self, world: PlanarWorld, start: int, rng: np.random.Generator | None) -> None:
        """The same in every state."""
        _give(world, lambda near: near if self._holds else set())


def _give(world: PlanarWorld, given: Callable[[set[int]], set[int]]) -> None:
    """The gripper holds what is given from now on, before the next substep."""
    world.hold = GivenHold(given)
    world.hold.update(world, 0.0)


def bayes_bound(
    dataset: Dataset, chain: ModeChain | None = None, every: int = EVERY, samples: int = SAMPLES
) -> dict[str, Any]:
    """`moving_errors` of each prediction of the windows of `forced_windows`, 0.5 s long.

    Predictions are a simulation of the likeliest hidden part, and the mean of ``samples``; the
    squared error of a mean is without what the number of samples adds to it, the variance of their
    mean. Without a ``chain`` there is no filter of interacting models. Raises `InvalidInputError`
    as `recorded_task` and `branches`, and where the data have no hidden hold.
    """
    for trajectory in dataset:
        metadata = trajectory.scene.metadata
        name = metadata.get("task")
        if name not in POSTERIORS or not metadata.get("hidden_switch", True):
            raise InvalidInputError(
                "the bound is of suction --hidden-switch, release, delay and sticky, found "
                f"{f'{name} without it' if name in POSTERIORS else name}"
            )
    steps = horizon_steps(dataset, None)
    moving: list[tuple[int, float]] = []
    squared: dict[str, list[float]] = {}
    for index, trajectory in enumerate(dataset):
        drawn = {"Bayes": POSTERIORS[str(trajectory.scene.metadata["task"])](trajectory)}
        if chain is not None:
            drawn["interacting models"] = InteractingModels(trajectory, chain)
        fixed = {f"prior-{name}": Assumed(trajectory, name == "hold") for name in ("hold", "touch")}
        rngs = {name: np.random.default_rng([1, index]) for name in drawn}
        task = recorded_task(dataset, trajectory)
        for branch in branches(task, trajectory, steps, controls_of(index), every):
            window = _Window(branch, steps)
            moving.append((index, float(window.moves.sum())))
            found = {name: window.error(each) for name, each in fixed.items()}
            for name, each in drawn.items():
                found[f"{name}, likeliest"] = window.error(each)
                found[f"{name}, mean"] = window.error_of_mean(each, samples, rngs[name])
            for name, error in found.items():
                squared.setdefault(name, []).append(error)
    episode, bodies = np.array(moving).T
    return {
        "windows": len(moving),
        "episodes": len(dataset),
        "predictions": {
            name: moving_errors(np.array(squared[name]), bodies, episode)
            for name in sorted(squared)
        },
    }


class _Window:
    """A forced window, and the errors of its simulations: sums over moving bodies of mean squares,
    m^2."""

    def __init__(self, branch: Branch, steps: int) -> None:
        self._branch, self._steps = branch, steps
        self._true = self._simulated(copy.deepcopy(branch))
        self.moves = moving_bodies(self._true)

    def error(self, posterior: Posterior) -> float:
        """Of the likeliest hidden part."""
        return self._summed((self._redrawn(posterior, None) - self._true) ** 2)

    def error_of_mean(self, posterior: Posterior, samples: int, rng: np.random.Generator) -> float:
        """Of the mean of all simulations, estimated without bias."""
        drawn = np.stack([self._redrawn(posterior, rng) for _ in range(samples)])
        excess = drawn.var(axis=0, ddof=1) / samples
        return max(self._summed((drawn.mean(axis=0) - self._true) ** 2 - excess), 0.0)

    def _redrawn(self, posterior: Posterior, rng: np.random.Generator | None) -> np.ndarray:
        other: Any = copy.deepcopy(self._branch)
        posterior.redraw(other.task.world, other.start, rng)
        return self._simulated(other)

    def _simulated(self, branch: Branch) -> np.ndarray:
        return branch.trajectory(self._steps).position[branch.start :]

    def _summed(self, squared: np.ndarray) -> float:
        return float(squared[1:].sum(axis=-1).mean(axis=0) @ self.moves)


def model_errors(name: str, dataset: Dataset, every: int) -> dict[str, Any]:
    """`moving_errors` of a trained model in the same windows, which corrects beliefs by motion."""
    model = stored_model(name)
    task_of = partial(recorded_task, dataset)
    windows, episodes = forced_windows(
        in_steps_of(model, dataset, "the data"), task_of, horizon_steps(dataset, None), every
    )
    noise = motion_evidence(model, asked=True, ignored=False)
    metrics = evaluate_open_loop(model, windows, motion_noise=noise, last_window_of=episodes)
    values = metrics.to_json()
    ends = ("rmse", "rmse_interval", "mean", "mean_interval")
    return {end: values[f"n_step_{end}_moving_inferred_m"] for end in ends}


def error_table(predictions: Mapping[str, Mapping[str, Any]]) -> StudyTable:
    """A row for each prediction."""

    def text(errors: Mapping[str, Any], name: str) -> str:
        low, high = (short(100.0 * end) for end in errors[f"{name}_interval"])
        return f"{short(100.0 * errors[name])} ({low} to {high})"

    return StudyTable(
        title="Forced windows",
        caption="Errors of the bodies that move, cm, with intervals of 95 % over episodes.",
        headings={
            "name": "prediction",
            "rmse": "RMSE, cm",
            "mean": "mean of the windows' errors, cm",
        },
        rows=[
            {"name": name, "rmse": text(errors, "rmse"), "mean": text(errors, "mean")}
            for name, errors in predictions.items()
        ],
    )


def main(
    data: Positional[Path],
    train: Path | None = None,
    model: str | None = None,
    json: Path | None = None,
    every: int = EVERY,
    samples: int = SAMPLES,
) -> None:
    """Measure the least error of predictions on forced windows of a dataset with a hidden hold.

    Args:
        data: A dataset file (HDF5) of suction --hidden-switch, release, delay or sticky.
        train: A dataset file to count the transitions of the interacting models in.
        model: A run folder or a model to measure beside, as `contactgraph evaluate --forced` does.
        json: Write the numbers to this file.
        every: States from one window to the next.
        samples: Simulations of a window, of whose mean the error is measured.
    """
    check_writable(json)
    check_range("--every", every, 1, 100_000)
    check_range("--samples", samples, 2, 100_000)
    dataset = read_trajectories(data)
    chain = None if train is None else ModeChain.counted(read_trajectories(train))
    found = bayes_bound(dataset, chain, every, samples)
    if model is not None:
        found["predictions"][model] = model_errors(model, dataset, every)
    write_json(json, {"data": str(data), **found})
    print(f"{data}: {found['windows']} windows of {found['episodes']} episodes")
    print(error_table(found["predictions"]).markdown())


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except InvalidInputError as error:
        print(f"bayes_bound: {error}", file=sys.stderr)
        sys.exit(2)
