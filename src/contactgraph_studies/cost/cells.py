"""From what is declared to the cells that measure it: demonstrations, costs, tests."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from contactgraph_studies.cell import Cell
from contactgraph_studies.cost.declared import (
    BYSTANDERS,
    LEARNED_AHEAD,
    OWN_COST,
    SCENE_SEED,
    CostAmounts,
    CostTask,
    Demonstrator,
    Lesson,
    Trial,
    lessons,
    trials,
)
from contactgraph_studies.measurement import Measurement


@dataclass(frozen=True)
class Learned:
    """What a number is of: a cost, and how long it took to learn it."""

    task: str
    lesson: Lesson


@dataclass(frozen=True)
class Controlled:
    """What a number is of: control with a learned cost."""

    task: str
    trial: Trial


@dataclass(frozen=True)
class Demonstrated:
    """What a number is of: control with the task's own cost, which is then to be found."""

    task: str


Place = Learned | Controlled | Demonstrated


def cost_measurements(tasks: Sequence[CostTask], amounts: CostAmounts) -> list[Measurement[Place]]:
    """All of the study, seed after seed."""
    return [one for seed in amounts.seeds for task in tasks for one in _of(task, seed, amounts)]


def _of(task: CostTask, seed: int, amounts: CostAmounts) -> Iterator[Measurement[Place]]:
    own = demonstrations(task, OWN_COST, seed, amounts)
    yield Measurement(Demonstrated(task.name), seed, own)
    for lesson in lessons(task, amounts):
        cell = learning(task, lesson, seed, amounts)
        yield Measurement(Learned(task.name, lesson), seed, cell)
    for trial in trials(task, amounts):
        learned = learning(task, trial.lesson, seed, amounts)
        # These are the scenes that are shown.
        save = trial.distractors == BYSTANDERS and seed == amounts.seeds[0]
        tested = _test(task, trial, seed, learned, amounts, save)
        yield Measurement(Controlled(task.name, trial), seed, tested)


def demonstrations(
    task: CostTask, demonstrator: Demonstrator, seed: int, amounts: CostAmounts
) -> Cell:
    """Recorded runs; of MPC, what is measured of them, with the runs beside it."""
    beginning = _folder(task, seed) + demonstrator.slug
    counts = ("--episodes", str(amounts.most), "--seed", str(seed))
    among = _distractors(demonstrator.distractors)
    if demonstrator.planned:
        output = f"{beginning}.json"
        recorded = f"{beginning}.h5"
        files = ("--json", output, "--save", recorded)
        hidden = demonstrator.hidden
        known = () if hidden is None else (learning(task, hidden, seed, amounts),)
        # As far ahead as the learner looks: its answer is known only then.
        ahead = ("--horizon", str(LEARNED_AHEAD)) if known else ()
        cost = (*(word for cell in known for word in ("--cost", cell.output)), *ahead)
        arguments = ("control", task.name, task.name, *cost, *counts, *among, *files)
        return Cell(output, arguments, f"control {task.name}", known, (recorded,))
    output = f"{beginning}.h5"
    kind = ("--goal", "fixed", "--expert", "demo")
    arguments = ("collect", task.name, *kind, *counts, *among, "--out", output)
    return Cell(output, arguments, f"collect {task.name}")


def learning(task: CostTask, lesson: Lesson, seed: int, amounts: CostAmounts) -> Cell:
    """The cost file."""
    data = demonstrations(task, lesson.demonstrator, seed, amounts)
    recorded = data.output.replace(".json", ".h5")
    output = f"{_folder(task, seed)}{lesson.slug}/cost.json"
    options = ("--runs", str(lesson.runs), *lesson.options)
    arguments = ("learn-cost", task.name, recorded, *options, "--out", output)
    return Cell(output, arguments, f"learn-cost {task.name}", (data,))


def _test(
    task: CostTask, trial: Trial, seed: int, learned: Cell, amounts: CostAmounts, save: bool
) -> Cell:
    output = learned.output.replace("cost.json", f"control-{trial.distractors}-distractors.json")
    among = _distractors(trial.distractors)
    beside = (output.replace(".json", ".h5"),) if save else ()
    saved = ("--save", *beside) if save else ()
    return Cell(
        output,
        (
            *("control", task.name, task.name, "--cost", learned.output),
            *("--episodes", str(amounts.episodes), "--seed", str(SCENE_SEED + seed)),
            *among,
            *("--json", output),
            *saved,
        ),
        " ".join(("control", task.name, *among)),
        (learned,),
        beside,
    )


def _folder(task: CostTask, seed: int) -> str:
    return f"cells/{task.name}/seed-{seed}/"


def _distractors(count: int) -> tuple[str, ...]:
    return ("--distractors", str(count)) if count else ()
