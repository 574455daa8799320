"""Jobs of the study of models: data, trainings and tests."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum, auto
from functools import cached_property, partial
from typing import Any

import numpy as np

from contactgraph.cli.options import option_arguments
from contactgraph.envs.registry import TestCondition
from contactgraph_studies.bootstrap import Sample, root_mean_square
from contactgraph_studies.job import Job, Measurement, Options
from contactgraph_studies.paper.config import (
    FAMILIES,
    TEST_SEED,
    Amounts,
    Family,
    StudyModel,
    StudyTask,
)
from contactgraph_studies.results import Quantity, Results, Values


class Source(StrEnum):
    """The kind of test that a number comes from."""

    recorded = auto()
    """Open loop, on recorded expert trajectories."""
    planned = auto()
    """Closed loop, replanned every half second."""
    every_step = auto()
    """Closed loop, replanned every step."""
    long_plan = auto()
    """Closed loop, planned over a whole episode: the growth of Full-AB shows there."""
    growth = auto()
    """Rolled out over a whole episode."""
    samples = auto()
    """Open loop, by number of training trajectories."""


@dataclass(frozen=True)
class ModelCondition:
    """The condition of a number; the fields are its labels in ``results.json``."""

    source: Source
    task: str
    model: str
    scenes: str
    training_runs: int | None = None
    """For `Source.samples`."""


def _planned_cm(values: Values) -> float:
    """NaN where the controller moves no object, infinite where a plan diverged."""
    error = values["n_step_rmse_planned_m"]
    if error is not None:
        moves = values["n_step_rmse_planned_moving_m"] is not None
        return 100.0 * error if moves else math.nan
    still = values.get("planned_windows") and values.get("planned_moved_objects") == 0
    return math.nan if still else math.inf


def _root_mean_square_of(key: str) -> Quantity:
    """Of a list of errors, m; null: unknown."""
    each = Quantity(key, "cm", 100.0)

    def read(values: Values) -> float:
        return float(root_mean_square(np.array([each.number(one) for one in values[key] or []])))

    return replace(each, derived=read)


PLANNED_ERROR = Quantity("n_step_rmse_planned_m", "cm", derived=_planned_cm)
"""Planned against executed positions: the paper's metric."""
PLANNED_BY_EPISODE = _root_mean_square_of("n_step_rmse_planned_moving_by_episode_m")
"""The same over the bodies that move, of each episode; one number is that over the episodes."""
RECORDED_BY_RUN = _root_mean_square_of("n_step_rmse_moving_by_run_m")
"""Open loop, of each recorded trajectory; one number is that over them."""
SUCCESS_BY_EPISODE = Quantity("success_by_episode", "%", 100.0)
RECORDED_ERROR = Quantity("n_step_rmse_m", "cm", 100.0, null=math.inf)
"""Open loop."""
CONSTANT_VELOCITY = Quantity("constant_velocity_planned_rmse_m", "cm", 100.0)
FIXED_CONTACT = Quantity("frozen_contact_planned_rmse_m", "cm", 100.0)
"""The two baselines on the same windows as `PLANNED_ERROR`."""
EDGE_F1 = Quantity("edge_f1")
EDGE_ACCURACY = Quantity("edge_accuracy", "%", 100.0)
PLANNED_ACCURACY = Quantity("edge_accuracy_planned", "%", 100.0)
UNMEASURED_ACCURACY = Quantity("edge_accuracy_unmeasured", "%", 100.0)
"""Without contact measurements."""


def condition_of(
    source: Source,
    task: StudyTask,
    model: StudyModel,
    scenes: TestCondition,
    training_runs: int | None = None,
) -> ModelCondition:
    """The labels of a test."""
    return ModelCondition(source, task.name, model.name, scenes.name, training_runs)


planned, recorded = partial(condition_of, Source.planned), partial(condition_of, Source.recorded)


def measurements(tasks: Sequence[StudyTask], amounts: Amounts) -> list[Measurement]:
    """All of a study, seed by seed."""
    return [one for seed in amounts.seeds for task in tasks for one in _of(task, seed, amounts)]


def _of(task: StudyTask, seed: int, amounts: Amounts) -> Iterator[Measurement]:
    for family in FAMILIES:
        for model in family.models:
            if model in task.models:
                yield from _of_model(task, family, model, seed, amounts)
    for family in task.families if task.with_samples else ():
        for runs, model in itertools.product(
            amounts.sample_sizes, (family.gim_temp, family.no_gim_aug)
        ):
            one = _TrainedModel(task, model, seed, runs, amounts)
            # At 40 trajectories a job of the main table, found by its output and run once.
            name = f"recorded-{task.hardest.slug}"
            yield one.evaluate(Source.samples, task.hardest, name, training_runs=runs)


def _of_model(
    task: StudyTask, family: Family, model: StudyModel, seed: int, amounts: Amounts
) -> Iterator[Measurement]:
    trained_on, long = task.as_trained, str(task.run_steps)
    episodes = ("--episodes", str(amounts.episodes), "--replan-every", str(task.steps_ahead))
    long_plan = (
        *("--episodes", str(amounts.long_episodes), "--horizon", long),
        *("--replan-every", "50", "--iterations", "40"),
    )
    whole = model is family.gim_temp
    runs = task.augmented_runs if model.augmented else task.training_runs
    one = _TrainedModel(task, model, seed, runs, amounts)
    for scenes in task.conditions:
        yield one.evaluate(Source.recorded, scenes, f"recorded-{scenes.slug}")
        options = (*episodes, *task.planned_options)
        # The page shows episodes of GIM-Temp.
        yield one.control(Source.planned, scenes, "planned", options, save=whole)
        if whole:
            most = amounts.success_episodes if scenes == trained_on else amounts.episodes
            yield one.control(Source.every_step, scenes, "every-step", ("--episodes", str(most)))
    if model in (family.gim_temp, family.full_ab) and family.full_ab in task.models:
        yield one.evaluate(Source.growth, trained_on, "growth", ("--growth-steps", long))
        yield one.control(Source.long_plan, trained_on, "long-plan", long_plan)


@dataclass(frozen=True)
class _TrainedModel:
    """A model, its training and its tests."""

    task: StudyTask
    model: StudyModel
    seed: int
    runs: int
    amounts: Amounts

    @property
    def folder(self) -> str:
        return f"cells/{self.task.name}/seed-{self.seed}"

    @cached_property
    def training(self) -> Job:
        task, model = self.task, self.model
        options = task.augmented_options if model.augmented else ()
        data = self.trajectories(
            f"{self.folder}/{'augmented' if model.augmented else 'train'}-{self.runs}.h5",
            *("--episodes", str(_with_held_out(self.runs)), "--seed", str(self.seed), *options),
        )
        output = f"{self.folder}/{model.slug}-{self.runs}/run"
        distance = ("--contact-distance", task.prior_distance) if model.own_form else ()
        arguments = (
            *("train", data.output, "--out", output, "--seed", str(self.seed)),
            *("--held-out", "0.2", *model.options, *distance),
            *self.amounts.training_options,
        )
        group = f"train {task.name} {model.slug}"
        return Job(output, arguments, group, (data,), checkpoints="checkpoint-*.safetensors")

    def trajectories(self, output: str, *options: str) -> Job:
        """Expert trajectories."""
        arguments = ("collect", self.task.name, *options, "--out", output)
        return Job(output, arguments, f"collect {self.task.name}")

    def evaluate(
        self,
        source: Source,
        scenes: TestCondition,
        name: str,
        options: Options = (),
        **labels: Any,
    ) -> Measurement:
        """Predictions of expert trajectories in scenes that are in no training data."""
        counts = ("--episodes", str(self.amounts.test_runs), "--seed", str(TEST_SEED))
        output = f"cells/{self.task.name}/test-{scenes.slug}.h5"
        data = self.trajectories(output, *counts, *option_arguments(scenes.options))
        output = self.training.output.removesuffix("run") + f"{name}.json"
        arguments = ("evaluate", self.training.output, data.output, *options, "--json", output)
        group = f"evaluate {data.output} after {self.training.group}"
        job = Job(output, arguments, group, (self.training, data))
        condition = condition_of(source, self.task, self.model, scenes, **labels)
        return Measurement(condition, self.seed, job)

    def control(
        self,
        source: Source,
        scenes: TestCondition,
        name: str,
        options: Options,
        save: bool = False,
    ) -> Measurement:
        """Closed-loop episodes."""
        path = self.training.output.removesuffix("run") + f"{name}-{scenes.slug}"
        output, saved = f"{path}.json", (f"{path}.h5",) if save else ()
        arguments = (
            *("control", self.training.output, self.task.name, "--seed", str(TEST_SEED)),
            *(*option_arguments(scenes.options), *options, "--json", output),
            *(("--save", *saved) if save else ()),
        )
        group = f"{name} {scenes.slug} after {self.training.group}"
        job = Job(output, arguments, group, (self.training,), saved)
        return Measurement(condition_of(source, self.task, self.model, scenes), self.seed, job)


def _with_held_out(runs: int) -> int:
    """Trajectories of which this many are left when a fifth is held out."""
    return round(runs / 0.8)


def closed_error(
    results: Results, task: StudyTask, model: StudyModel, scenes: TestCondition
) -> Sample:
    """Planned against executed positions over the bodies that move, cm."""
    condition = planned(task, model, scenes)
    return results.scene_sample(condition, PLANNED_BY_EPISODE, root_mean_square)


def open_error(results: Results, task: StudyTask, model: StudyModel, runs: int) -> Sample:
    """Open-loop error out of distribution over the bodies that move, cm, by number of training
    trajectories."""
    condition = condition_of(Source.samples, task, model, task.hardest, training_runs=runs)
    return results.scene_sample(condition, RECORDED_BY_RUN, root_mean_square)
