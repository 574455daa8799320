"""From what is declared to the cells that measure it: data, trainings, tests."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

from contactgraph_studies.cell import Cell
from contactgraph_studies.declared import (
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
from contactgraph_studies.measurement import Measurement


class Source(Enum):
    """Where numbers come from."""

    recorded = "open loop, on recorded expert runs"
    planned = "closed loop, planned anew every half second"
    every_step = "closed loop, planned anew every step"
    long_plan = "closed loop, planned over the whole run"
    growth = "rolled out over a whole run"
    samples = "open loop, by number of training runs"
    faults = "open loop, with a faulty contact sensor"


@dataclass(frozen=True)
class Where:
    """What a number is of."""

    source: Source
    task: str
    """Names, as are the next two."""
    model: str
    condition: str
    fault: str = ""
    runs: int = 0
    """Training runs, for `Source.samples`."""


def measurements(tasks: Sequence[StudyTask], amounts: Amounts) -> list[Measurement[Where]]:
    """All of a study: GIM-Temp against its targets first, then the rest, seed after seed."""
    every = [one for seed in amounts.seeds for task in tasks for one in _of(task, seed, amounts)]
    aims = (Source.recorded, Source.planned, Source.every_step)
    return sorted(
        every,
        key=lambda one: not (one.where.model == GIM_TEMP.name and one.where.source in aims),
    )


def conditions_of(task: StudyTask, amounts: Amounts) -> list[TestCondition]:
    """Those that are measured."""
    return [one for one in task.conditions if amounts.extras or not one.extra]


def _of(task: StudyTask, seed: int, amounts: Amounts) -> Iterator[Measurement[Where]]:
    for model in task.models:
        runs = task.augmented_runs if model.augmented else task.training_runs
        trained = training(task, model, seed, runs, amounts)
        for condition in conditions_of(task, amounts):
            data = test_data(task, condition, amounts)
            yield _recorded(task, model, condition, seed, trained, data)
            yield _planned(task, model, condition, seed, trained, amounts)
            if model is GIM_TEMP:
                yield _every_step(task, condition, seed, trained, amounts)
        fresh = test_data(task, task.as_trained, amounts)
        if model is GIM_TEMP:
            yield from (_faulty(task, seed, trained, fresh, fault) for fault in FAULTS)
        if model in (GIM_TEMP, FULL_AB) and FULL_AB in task.models:
            yield _growth(task, model, seed, trained, fresh)
            yield _long_plan(task, model, seed, trained)
    if task.with_samples:
        yield from _samples(task, seed, amounts)


def training_data(task: StudyTask, augmented: bool, runs: int, seed: int) -> Cell:
    """Recorded expert runs to train on."""
    kind = "augmented" if augmented else "train"
    output = f"cells/{task.name}/seed-{seed}/{kind}-{runs}.h5"
    options = task.augmented_options if augmented else ()
    arguments = ("collect", task.name, "--episodes", str(runs), "--seed", str(seed), *options)
    return Cell(output, (*arguments, "--out", output), f"collect {task.name}")


def test_data(task: StudyTask, condition: TestCondition, amounts: Amounts) -> Cell:
    """Recorded expert runs in scenes that no training has seen."""
    output = f"cells/{task.name}/test-{condition.slug}.h5"
    counts = ("--episodes", str(amounts.test_runs), "--seed", str(TEST_SEED))
    arguments = ("collect", task.name, *counts, *condition.options, "--out", output)
    return Cell(output, arguments, f"collect {task.name}")


def training(task: StudyTask, model: StudyModel, seed: int, runs: int, amounts: Amounts) -> Cell:
    """The run folder of a model trained on so many runs."""
    data = training_data(task, model.augmented, runs, seed)
    output = f"cells/{task.name}/seed-{seed}/{model.slug}-{runs}/run"
    return Cell(
        output,
        (
            *("train", data.output, "--out", output),
            *model.options,
            *("--seed", str(seed)),
            *task.training_options,
            *amounts.training_options,
        ),
        f"train {task.name} {model.slug}",
        (data,),
        checkpoints="checkpoint-*.safetensors",
    )


def _beside(trained: Cell, name: str) -> str:
    return f"{trained.output.removesuffix('/run')}/{name}"


def _evaluation(trained: Cell, data: Cell, name: str, options: Sequence[str] = ()) -> Cell:
    output = _beside(trained, f"{name}.json")
    arguments = ("evaluate", trained.output, data.output, *options, "--json", output)
    return Cell(output, arguments, f"evaluate {data.output} after {trained.kind}", (trained, data))


def _recorded(
    task: StudyTask,
    model: StudyModel,
    condition: TestCondition,
    seed: int,
    trained: Cell,
    data: Cell,
) -> Measurement[Where]:
    where = Where(Source.recorded, task.name, model.name, condition.name)
    return Measurement(where, seed, _evaluation(trained, data, f"recorded-{condition.slug}"))


def _faulty(
    task: StudyTask, seed: int, trained: Cell, data: Cell, fault: SensorFault
) -> Measurement[Where]:
    where = Where(Source.faults, task.name, GIM_TEMP.name, task.as_trained.name, fault=fault.name)
    return Measurement(where, seed, _evaluation(trained, data, fault.slug, fault.options))


def _growth(
    task: StudyTask, model: StudyModel, seed: int, trained: Cell, data: Cell
) -> Measurement[Where]:
    where = Where(Source.growth, task.name, model.name, task.as_trained.name)
    options = ("--growth-steps", str(task.run_steps))
    return Measurement(where, seed, _evaluation(trained, data, "growth", options))


def _samples(task: StudyTask, seed: int, amounts: Amounts) -> Iterator[Measurement[Where]]:
    for runs in amounts.sample_sizes:
        for model in (GIM_TEMP, NO_GIM_AUG):
            trained = training(task, model, seed, runs, amounts)
            for condition in (task.as_trained, task.hardest):
                data = test_data(task, condition, amounts)
                where = Where(Source.samples, task.name, model.name, condition.name, runs=runs)
                # At 40 runs the very cell of the main table: found by its output, made once.
                cell = _evaluation(trained, data, f"recorded-{condition.slug}")
                yield Measurement(where, seed, cell)


def _control(
    task: StudyTask,
    condition: TestCondition,
    trained: Cell,
    name: str,
    options: Sequence[str],
    save: bool = False,
) -> Cell:
    output = _beside(trained, f"{name}-{condition.slug}.json")
    beside = (output.replace(".json", ".h5"),) if save else ()
    saved = ("--save", *beside) if save else ()
    return Cell(
        output,
        (
            *("control", trained.output, task.name, "--seed", str(TEST_SEED)),
            *condition.options,
            *options,
            *("--json", output),
            *saved,
        ),
        f"{name} {condition.slug} after {trained.kind}",
        (trained,),
        beside,
    )


def _planned(
    task: StudyTask,
    model: StudyModel,
    condition: TestCondition,
    seed: int,
    trained: Cell,
    amounts: Amounts,
) -> Measurement[Where]:
    where = Where(Source.planned, task.name, model.name, condition.name)
    options = (
        *("--episodes", str(amounts.episodes), "--replan-every", str(task.steps_ahead)),
        *task.followed_options,
    )
    save = model is GIM_TEMP  # these are the scenes that are shown
    return Measurement(where, seed, _control(task, condition, trained, "planned", options, save))


def _every_step(
    task: StudyTask, condition: TestCondition, seed: int, trained: Cell, amounts: Amounts
) -> Measurement[Where]:
    where = Where(Source.every_step, task.name, GIM_TEMP.name, condition.name)
    options = ("--episodes", str(amounts.success_episodes))
    return Measurement(where, seed, _control(task, condition, trained, "every-step", options))


def _long_plan(task: StudyTask, model: StudyModel, seed: int, trained: Cell) -> Measurement[Where]:
    """The paper plans Full-AB over a whole run: there its growth shows."""
    where = Where(Source.long_plan, task.name, model.name, task.as_trained.name)
    options = ("--episodes", "5", "--horizon", str(task.run_steps), "--replan-every", "50")
    cell = _control(task, task.as_trained, trained, "long-plan", options)
    return Measurement(where, seed, cell)
