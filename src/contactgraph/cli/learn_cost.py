"""``contactgraph learn-cost``: the cost that demonstrations were made by."""

import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from contactgraph.cli.tasks import KnownTask
    from contactgraph.control import ControlLimits
    from contactgraph.data import Dataset


@dataclass(frozen=True)
class LearnCost:
    """Learn from demonstrations what they want: a quadratic cost that control can plan with."""

    model: Positional[Annotated[str, arg(metavar="MODEL")]]
    """A run folder, a model file, or a model that ships with the package (pickup)."""
    demonstrations: Positional[Annotated[Path, arg(metavar="DEMOS")]]
    """The dataset file (HDF5) of runs that do what is wanted, each of a scene with a goal."""
    out: Annotated[Path, arg(metavar="FILE")]
    """The file to write (.json)."""
    horizon: Annotated[int | None, arg(metavar="INT")] = None
    """Steps to plan ahead, as control will; 20, for franka 50, if not given."""
    steps: int = 400
    """Optimiser steps."""
    seed: int = 0
    """Of the order in which windows of the demonstrations are looked at."""
    runs: Annotated[int | None, arg(metavar="INT")] = None
    """Learn from the first so many runs alone; all of them if not given."""
    goal: Annotated[tuple[float, ...] | None, arg(metavar="X Y")] = None
    """The goal of all runs, in m: where runs have none, or in place of theirs."""
    max_force: Annotated[float | None, arg(metavar="N")] = None
    """What the control could be at most on each axis, N; the task's own bound if not given."""
    prior_weight: float = 3.0
    """How dear it is to tie terms or axes together that stand for themselves; 0: free."""
    picture: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write a picture of the cost to this file (.png)."""

    def run(self) -> None:
        """Learn, and say what was found."""
        from contactgraph.cli.cost_words import participant_lines, term_lines
        from contactgraph.cli.models import in_steps_of, model_path
        from contactgraph.cli.options import check_range, check_seed, check_weight
        from contactgraph.cli.output import (
            check_suffix,
            check_writable,
            progress,
            provenance,
            sha256,
        )
        from contactgraph.control import CostLearningConfig, learn_cost, write_cost
        from contactgraph.data import InvalidInputError
        from contactgraph.model.io import load_model
        from contactgraph.viz import write_cost_picture

        check_suffix("--out", self.out, ".json")
        check_suffix("--picture", self.picture, ".png")
        for path in (self.out, self.picture):
            check_writable(path)
        if self.horizon is not None:
            check_range("--horizon", self.horizon, 1, 1000)
        check_range("--steps", self.steps, 1, 1_000_000)
        check_seed(self.seed)
        if self.max_force is not None and not 0.0 < self.max_force < math.inf:
            raise InvalidInputError(f"--max-force must be positive, found {self.max_force}")
        check_weight("--prior-weight", self.prior_weight)
        model_file = model_path(self.model)
        dataset = self._dataset()
        recipe = CostLearningConfig(
            horizon=self._horizon(dataset) if self.horizon is None else self.horizon,
            steps=self.steps,
            prior_weight=self.prior_weight,
        )
        model = load_model(model_file).model
        dataset = in_steps_of(model, dataset, str(self.demonstrations))
        began = time.perf_counter()
        with progress("learning", recipe.steps) as steps:
            try:
                cost = learn_cost(
                    model,
                    dataset,
                    recipe,
                    goal=self.goal,
                    limits=self._limits(dataset),
                    seed=self.seed,
                    on_step=lambda done, loss: steps.advance(done, f"imitation loss {loss:.4f}"),
                )
            except InvalidInputError as error:
                raise InvalidInputError(f"{self.demonstrations}: {error}") from error
        seconds = time.perf_counter() - began
        made: dict[str, Any] = {
            "model": self.model,
            "model_sha256": sha256(model_file),
            "demonstrations": str(self.demonstrations),
            "demonstrations_sha256": sha256(self.demonstrations),
            "runs": len(dataset),
            "data": dataset.metadata,
            "recipe": asdict(recipe),
            "goal": "the runs' own" if self.goal is None else list(self.goal),
            "max_force": self._bound(dataset),
            "seed": self.seed,
            "seconds": round(seconds, 1),
            **provenance(),
        }
        write_cost(self.out, cost, made)
        if self.picture is not None:
            write_cost_picture(self.picture, cost)
        for line in (*participant_lines(cost), *term_lines(cost)):
            print(line)
        many = f"{len(dataset)} demonstrations" if len(dataset) > 1 else "1 demonstration"
        print(f"{self.out}: learned from {many} in {seconds:.1f} s")
        if self.picture is not None:
            print(f"{self.picture}: the cost as a picture")

    def _dataset(self) -> "Dataset":
        """The runs to learn from; whatever can be said against them without a model is said."""
        from contactgraph.data import Dataset, InvalidInputError, read_trajectories

        found = read_trajectories(self.demonstrations)
        if self.goal is not None:
            goal = " ".join(f"{number:g}" for number in self.goal)
            if len(self.goal) != found.dimension or not all(map(math.isfinite, self.goal)):
                raise InvalidInputError(
                    f"--goal must be {found.dimension} finite numbers [m], found {goal or 'none'}"
                )
        if self.runs is None:
            return found
        if not 1 <= self.runs <= len(found):
            raise InvalidInputError(
                f"--runs must be 1 to {len(found)}, the runs in {self.demonstrations}, found "
                f"{self.runs}"
            )
        return Dataset(found.trajectories[: self.runs], found.metadata)

    def _bound(self, dataset: "Dataset") -> float | None:
        """N: what is said, or else what the task that the data set names allows."""
        known = _task_of(dataset)
        bound = None if known is None else known.max_force
        return bound if self.max_force is None else self.max_force

    def _limits(self, dataset: "Dataset") -> "ControlLimits | None":
        import jax.numpy as jnp

        from contactgraph.control import ControlLimits

        bound = self._bound(dataset)
        if bound is None:
            return None
        upper = jnp.full(dataset.control_size, bound)
        return ControlLimits(-upper, upper)

    def _horizon(self, dataset: "Dataset") -> int:
        """What `control` plans ahead in the task that the data set names."""
        from contactgraph.control import CostLearningConfig

        known = _task_of(dataset)
        return CostLearningConfig().horizon if known is None else known.horizon


def _task_of(dataset: "Dataset") -> "KnownTask | None":
    """The task that the dataset names. A file does not get to import a class: names only."""
    from contactgraph.cli.tasks import known_task, task_names

    name = str(dataset.metadata.get("task"))
    return known_task(name) if name in task_names() else None
