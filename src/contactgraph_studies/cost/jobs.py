"""Jobs of the study of learned costs: demonstrations, learning, tests."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from contactgraph_studies.cost.config import (
    DISTRACTORS,
    LOOK_AHEAD,
    OWN_COST,
    SCENE_SEED,
    CostAmounts,
    CostCondition,
    CostTask,
    CostTest,
    Demonstrator,
    learned_costs,
    tests_of,
)
from contactgraph_studies.job import Job, Measurement


@dataclass(frozen=True)
class OwnCostLabels:
    """The labels of control with the task's own cost, in ``results.json``."""

    source: str
    task: str


@dataclass(frozen=True)
class CostLabels(OwnCostLabels):
    """The labels of learning a cost, and of control with it."""

    learned_from: str
    demonstrations: int
    distractors: int | None = None
    """Of control."""


def demonstrated(task: CostTask) -> OwnCostLabels:
    """Control with the task's own cost; these trajectories are demonstrations, too."""
    return OwnCostLabels("control with the task's own cost", task.name)


def learning(task: CostTask, learned: CostCondition) -> CostLabels:
    """Learning of a cost."""
    return CostLabels("learning", task.name, learned.name, learned.demonstrations)


def control(task: CostTask, test: CostTest) -> CostLabels:
    """Control with a learned cost."""
    learned = test.learned
    return CostLabels("control", task.name, learned.name, learned.demonstrations, test.distractors)


def cost_measurements(tasks: Sequence[CostTask], amounts: CostAmounts) -> list[Measurement]:
    """All of the study, seed by seed."""
    return [one for seed in amounts.seeds for task in tasks for one in _of(task, seed, amounts)]


def _of(task: CostTask, seed: int, amounts: CostAmounts) -> Iterator[Measurement]:
    own = demonstration_job(task, OWN_COST, seed, amounts)
    yield Measurement(demonstrated(task), seed, own)
    for learned in learned_costs(task, amounts):
        yield Measurement(learning(task, learned), seed, learning_job(task, learned, seed, amounts))
    for test in tests_of(task, amounts):
        job = learning_job(task, test.learned, seed, amounts)
        # The page shows these scenes.
        save = test.distractors == DISTRACTORS and seed == amounts.seeds[0]
        tested = _test_job(task, test, seed, job, amounts, save)
        yield Measurement(control(task, test), seed, tested)


def demonstration_job(
    task: CostTask, demonstrator: Demonstrator, seed: int, amounts: CostAmounts
) -> Job:
    """Demonstrations; those of MPC lie beside the numbers of control."""
    path = f"cells/{task.name}/seed-{seed}/{demonstrator.slug}"
    counts = ("--episodes", str(amounts.most), "--seed", str(seed))
    scenes = _distractors(demonstrator.distractors)
    if not demonstrator.planned:
        output = f"{path}.h5"
        expert = ("--goal", "fixed", "--expert", "demo")
        arguments = ("collect", task.name, *expert, *counts, *scenes, "--out", output)
        return Job(output, arguments, f"collect {task.name}")
    output, trajectories = f"{path}.json", f"{path}.h5"
    needs: tuple[Job, ...] = ()
    cost: tuple[str, ...] = ()
    if demonstrator.hidden is not None:
        needs = (learning_job(task, demonstrator.hidden, seed, amounts),)
        # The answer is known only for a horizon as long as the learner's.
        cost = ("--cost", needs[0].output, "--horizon", str(LOOK_AHEAD))
    files = ("--json", output, "--save", trajectories)
    arguments = ("control", task.name, task.name, *cost, *counts, *scenes, *files)
    return Job(output, arguments, f"control {task.name}", needs, (trajectories,))


def learning_job(task: CostTask, learned: CostCondition, seed: int, amounts: CostAmounts) -> Job:
    """The file of a learned cost."""
    data = demonstration_job(task, learned.demonstrator, seed, amounts)
    trajectories = data.output.replace(".json", ".h5")
    output = f"cells/{task.name}/seed-{seed}/{learned.slug}/cost.json"
    options = ("--runs", str(learned.demonstrations), *learned.options)
    arguments = ("learn-cost", task.name, trajectories, *options, "--out", output)
    return Job(output, arguments, f"learn-cost {task.name}", (data,))


def _test_job(
    task: CostTask, test: CostTest, seed: int, learned: Job, amounts: CostAmounts, save: bool
) -> Job:
    output = learned.output.replace("cost.json", f"control-{test.distractors}-distractors.json")
    scenes = _distractors(test.distractors)
    saved = (output.replace(".json", ".h5"),) if save else ()
    arguments = (
        *("control", task.name, task.name, "--cost", learned.output),
        *("--episodes", str(amounts.episodes), "--seed", str(SCENE_SEED + seed)),
        *scenes,
        *("--json", output),
        *(("--save", *saved) if saved else ()),
    )
    return Job(output, arguments, " ".join(("control", task.name, *scenes)), (learned,), saved)


def _distractors(count: int) -> tuple[str, ...]:
    return ("--distractors", str(count)) if count else ()
