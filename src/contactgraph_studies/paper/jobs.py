"""Jobs of the study of models: data, trainings and tests."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum, auto
from functools import cached_property

from contactgraph_studies.job import Job, Measurement
from contactgraph_studies.paper.config import (
    FAULTS,
    FULL_AB,
    GIM_TEMP,
    NO_GIM_AUG,
    TEST_SEED,
    Amounts,
    SensorFault,
    StudyModel,
    StudyTask,
    TestCondition,
)
from contactgraph_studies.results import Quantity


class Source(StrEnum):
    """The kind of test that a number comes from."""

    recorded = auto()
    """Open loop, on recorded expert trajectories."""
    planned = auto()
    """Closed loop, replanned every half second."""
    every_step = auto()
    """Closed loop, replanned every step."""
    long_plan = auto()
    """Closed loop, planned over a whole episode."""
    growth = auto()
    """Rolled out over a whole episode."""
    samples = auto()
    """Open loop, by number of training trajectories."""
    faults = auto()
    """Open loop, with a faulty contact sensor."""


@dataclass(frozen=True)
class ModelCondition:
    """The condition of a number; the fields are its labels in ``results.json``."""

    source: Source
    task: str
    model: str
    scenes: str
    sensor: str | None = None
    training_runs: int | None = None
    """For `Source.samples`."""


PLANNED_ERROR = Quantity("n_step_rmse_planned_m", 100.0, null=math.inf)
"""cm, planned against executed positions: the paper's metric."""
RECORDED_ERROR = Quantity("n_step_rmse_m", 100.0, null=math.inf)
"""cm, open loop."""
CONSTANT_VELOCITY = Quantity("constant_velocity_planned_rmse_m", 100.0)
FIXED_CONTACT = Quantity("frozen_contact_planned_rmse_m", 100.0)
"""cm, of the two baselines on the same windows."""
EDGE_F1 = Quantity("edge_f1")
EDGE_ACCURACY = Quantity("edge_accuracy", 100.0)
PLANNED_ACCURACY = Quantity("edge_accuracy_planned", 100.0)
UNMEASURED_ACCURACY = Quantity("edge_accuracy_unmeasured", 100.0)
"""%, without contact measurements."""


def planned(task: StudyTask, model: StudyModel, condition: TestCondition) -> ModelCondition:
    """Planned against executed trajectories."""
    return ModelCondition(Source.planned, task.name, model.name, condition.name)


def recorded(task: StudyTask, model: StudyModel, condition: TestCondition) -> ModelCondition:
    """Predictions of recorded expert trajectories."""
    return ModelCondition(Source.recorded, task.name, model.name, condition.name)


def measurements(tasks: Sequence[StudyTask], amounts: Amounts) -> list[Measurement]:
    """All of a study: the targets of GIM-Temp first, then the rest, seed by seed."""
    every = [one for seed in amounts.seeds for task in tasks for one in _of(task, seed, amounts)]
    first = (Source.recorded, Source.planned, Source.every_step)
    return sorted(
        every,
        key=lambda one: (
            not (one.condition.model == GIM_TEMP.name and one.condition.source in first)
        ),
    )


def conditions_of(task: StudyTask, amounts: Amounts) -> list[TestCondition]:
    """The test conditions that are measured."""
    return [one for one in task.conditions if amounts.extras or not one.extra]


def _of(task: StudyTask, seed: int, amounts: Amounts) -> Iterator[Measurement]:
    for model in task.models:
        runs = task.augmented_runs if model.augmented else task.training_runs
        trained = _TrainedModel(task, model, seed, runs, amounts)
        for condition in conditions_of(task, amounts):
            yield trained.recorded(condition)
            yield trained.planned(condition)
            if model is GIM_TEMP:
                yield trained.every_step(condition)
        if model is GIM_TEMP:
            yield from (trained.with_fault(fault) for fault in FAULTS)
        if model in (GIM_TEMP, FULL_AB) and FULL_AB in task.models:
            yield trained.growth()
            yield trained.long_plan()
    for runs in amounts.sample_sizes if task.with_samples else ():
        for model in (GIM_TEMP, NO_GIM_AUG):
            trained = _TrainedModel(task, model, seed, runs, amounts)
            # At 40 trajectories this is a job of the main table, found by its output and run once.
            yield trained.recorded(task.as_trained, Source.samples, runs)
            yield trained.recorded(task.hardest, Source.samples, runs)


def training_data(task: StudyTask, augmented: bool, runs: int, seed: int) -> Job:
    """Expert trajectories to train on."""
    kind = "augmented" if augmented else "train"
    output = f"cells/{task.name}/seed-{seed}/{kind}-{runs}.h5"
    options = task.augmented_options if augmented else ()
    arguments = ("collect", task.name, "--episodes", str(runs), "--seed", str(seed), *options)
    return Job(output, (*arguments, "--out", output), f"collect {task.name}")


def unseen_data(task: StudyTask, condition: TestCondition, amounts: Amounts) -> Job:
    """Expert trajectories in scenes that are in no training data."""
    output = f"cells/{task.name}/test-{condition.slug}.h5"
    counts = ("--episodes", str(amounts.test_runs), "--seed", str(TEST_SEED))
    arguments = ("collect", task.name, *counts, *condition.options, "--out", output)
    return Job(output, arguments, f"collect {task.name}")


@dataclass(frozen=True)
class _TrainedModel:
    """A model, its training and its tests."""

    task: StudyTask
    model: StudyModel
    seed: int
    runs: int
    amounts: Amounts

    @cached_property
    def _folder(self) -> str:
        return f"cells/{self.task.name}/seed-{self.seed}/{self.model.slug}-{self.runs}"

    @cached_property
    def _training(self) -> Job:
        data = training_data(self.task, self.model.augmented, self.runs, self.seed)
        output = f"{self._folder}/run"
        arguments = (
            *("train", data.output, "--out", output, *self.model.options),
            *("--seed", str(self.seed)),
            *self.task.training_options,
            *self.amounts.training_options,
        )
        group = f"train {self.task.name} {self.model.slug}"
        return Job(output, arguments, group, (data,), checkpoints="checkpoint-*.safetensors")

    def recorded(
        self,
        condition: TestCondition,
        source: Source = Source.recorded,
        training_runs: int | None = None,
    ) -> Measurement:
        job = self._evaluation(condition, f"recorded-{condition.slug}")
        return self._measurement(source, condition, job, training_runs=training_runs)

    def with_fault(self, fault: SensorFault) -> Measurement:
        scenes = self.task.as_trained
        job = self._evaluation(scenes, fault.slug, fault.options)
        return self._measurement(Source.faults, scenes, job, sensor=fault.name)

    def growth(self) -> Measurement:
        scenes = self.task.as_trained
        job = self._evaluation(scenes, "growth", ("--growth-steps", str(self.task.run_steps)))
        return self._measurement(Source.growth, scenes, job)

    def planned(self, condition: TestCondition) -> Measurement:
        options = (
            *("--episodes", str(self.amounts.episodes)),
            *("--replan-every", str(self.task.steps_ahead)),
            *self.task.planned_options,
        )
        # The page shows episodes of GIM-Temp.
        job = self._control(condition, "planned", options, save=self.model is GIM_TEMP)
        return self._measurement(Source.planned, condition, job)

    def every_step(self, condition: TestCondition) -> Measurement:
        options = ("--episodes", str(self.amounts.success_episodes))
        job = self._control(condition, "every-step", options)
        return self._measurement(Source.every_step, condition, job)

    def long_plan(self) -> Measurement:
        """The paper plans Full-AB over a whole episode, where its growth shows."""
        scenes = self.task.as_trained
        horizon = ("--horizon", str(self.task.run_steps), "--replan-every", "50")
        job = self._control(scenes, "long-plan", ("--episodes", "5", *horizon))
        return self._measurement(Source.long_plan, scenes, job)

    def _measurement(
        self,
        source: Source,
        scenes: TestCondition,
        job: Job,
        sensor: str | None = None,
        training_runs: int | None = None,
    ) -> Measurement:
        condition = ModelCondition(
            source, self.task.name, self.model.name, scenes.name, sensor, training_runs
        )
        return Measurement(condition, self.seed, job)

    def _evaluation(
        self, condition: TestCondition, name: str, options: tuple[str, ...] = ()
    ) -> Job:
        data = unseen_data(self.task, condition, self.amounts)
        output = f"{self._folder}/{name}.json"
        arguments = ("evaluate", self._training.output, data.output, *options, "--json", output)
        group = f"evaluate {data.output} after {self._training.group}"
        return Job(output, arguments, group, (self._training, data))

    def _control(
        self, condition: TestCondition, name: str, options: tuple[str, ...], save: bool = False
    ) -> Job:
        output = f"{self._folder}/{name}-{condition.slug}.json"
        saved = (output.replace(".json", ".h5"),) if save else ()
        arguments = (
            *("control", self._training.output, self.task.name, "--seed", str(TEST_SEED)),
            *condition.options,
            *options,
            *("--json", output),
            *(("--save", *saved) if saved else ()),
        )
        group = f"{name} {condition.slug} after {self._training.group}"
        return Job(output, arguments, group, (self._training,), saved)
