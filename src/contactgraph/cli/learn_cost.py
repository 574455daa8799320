"""``contactgraph learn-cost``: a cost function from demonstrations."""

import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from contactgraph.cli.options import (
    AUTO,
    Device,
    ModelArgument,
    check_range,
    check_seed,
    check_weight,
)
from contactgraph.data import Dataset, InvalidInputError, read_trajectories

if TYPE_CHECKING:
    from contactgraph.envs.registry import TaskSpec


@dataclass(frozen=True)
class LearnCost:
    """Learn from demonstrations a quadratic cost that control can plan with."""

    model: ModelArgument
    demonstrations: Positional[Annotated[Path, arg(metavar="DEMOS")]]
    """Dataset file (HDF5) of demonstrations, each in a scene with a goal."""
    out: Annotated[Path, arg(metavar="FILE")]
    """The file to write (.json)."""
    horizon: Annotated[
        int | None, arg(metavar="INT", help_behavior_hint="(default: 20; franka 50)")
    ] = None
    """Planning horizon, steps, as later for control."""
    steps: int = 400
    """Optimiser steps."""
    seed: int = 0
    """Random seed of the order in which windows of the demonstrations are used."""
    runs: Annotated[int | None, arg(metavar="INT", help_behavior_hint="(default: all)")] = None
    """Number of demonstrations to learn from, the first in the file."""
    goal: Annotated[
        tuple[float, ...] | None, arg(metavar="X Y", help_behavior_hint="(default: the scenes')")
    ] = None
    """Goal of all demonstrations, m."""
    max_force: Annotated[
        float | None, arg(metavar="N", help_behavior_hint="(default: the task's)")
    ] = None
    """Bound of the control on each axis, N."""
    prior_weight: float = 3.0
    """Weight of the prior towards independent cost terms and equal axes; 0: no prior."""
    without_contacts: bool = False
    """Learn Q and R alone, not what contacts that the demonstrations keep are worth."""
    device: Device = AUTO

    def run(self) -> None:
        """Learn the cost, write it, and print its terms."""
        import jax.numpy as jnp

        from contactgraph.cli.info import cost_lines
        from contactgraph.cli.models import in_steps_of, model_path, stored_model
        from contactgraph.cli.output import (
            check_suffix,
            check_writable,
            progress,
            provenance,
            sha256,
        )
        from contactgraph.control import ControlLimits, CostLearningConfig, learn_cost, write_cost

        check_suffix("--out", self.out, ".json")
        check_writable(self.out)
        if self.horizon is not None:
            check_range("--horizon", self.horizon, 1, 1000)
        check_range("--steps", self.steps, 1, 1_000_000)
        check_seed(self.seed)
        if self.max_force is not None and not 0.0 < self.max_force < math.inf:
            raise InvalidInputError(f"--max-force must be positive, found {self.max_force}")
        check_weight("--prior-weight", self.prior_weight)
        model_file = model_path(self.model)
        dataset = self._dataset()
        task = _task_of(dataset)
        default = (task and task.horizon) or CostLearningConfig().horizon
        config = CostLearningConfig(
            horizon=default if self.horizon is None else self.horizon,
            steps=self.steps,
            prior_weight=self.prior_weight,
            contacts=not self.without_contacts,
        )
        max_force, limits = self.max_force, None
        if max_force is None and task is not None:
            max_force = task.max_force
        if max_force is not None:
            bound = jnp.full(dataset.control_size, max_force)
            limits = ControlLimits(-bound, bound)
        model = stored_model(self.model)
        dataset = in_steps_of(model, dataset, str(self.demonstrations))
        started = time.perf_counter()
        with progress("learning", config.steps) as bar:
            try:
                cost = learn_cost(
                    model,
                    dataset,
                    config,
                    goal=self.goal,
                    limits=limits,
                    seed=self.seed,
                    on_step=lambda done, loss: bar.advance(done, f"imitation loss {loss:.4f}"),
                )
            except InvalidInputError as error:
                raise InvalidInputError(f"{self.demonstrations}: {error}") from error
        seconds = time.perf_counter() - started
        origin = {
            "model": self.model,
            "model_sha256": sha256(model_file),
            "demonstrations": str(self.demonstrations),
            "demonstrations_sha256": sha256(self.demonstrations),
            "runs": len(dataset),
            "data": dataset.metadata,
            "recipe": asdict(config),
            "goal": "the runs' own" if self.goal is None else list(self.goal),
            "max_force": max_force,
            "seed": self.seed,
            "seconds": round(seconds, 1),
            **provenance(),
        }
        write_cost(self.out, cost, origin)
        for line in cost_lines(cost):
            print(line)
        many = f"{len(dataset)} demonstrations" if len(dataset) > 1 else "1 demonstration"
        print(f"{self.out}: learned from {many} in {seconds:.1f} s")

    def _dataset(self) -> Dataset:
        """The demonstrations, checked as far as that needs no model."""
        dataset = read_trajectories(self.demonstrations)
        if self.goal is not None:
            goal = " ".join(f"{number:g}" for number in self.goal)
            if len(self.goal) != dataset.dimension or not all(map(math.isfinite, self.goal)):
                raise InvalidInputError(
                    f"--goal must be {dataset.dimension} finite numbers [m], found {goal or 'none'}"
                )
        if self.runs is None:
            return dataset
        if not 1 <= self.runs <= len(dataset):
            raise InvalidInputError(
                f"--runs must be 1 to {len(dataset)}, the trajectories in {self.demonstrations}, "
                f"found {self.runs}"
            )
        return Dataset(dataset.trajectories[: self.runs], dataset.metadata)


def _task_of(dataset: Dataset) -> "TaskSpec | None":
    """The task that the dataset names. A file does not get to import a class: names only."""
    from contactgraph.envs.registry import task_names, task_spec

    name = str(dataset.metadata.get("task"))
    return task_spec(name) if name in task_names() else None
