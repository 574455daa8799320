"""Jobs of the study of learned costs: demonstrations, learning, tests."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from contactgraph_studies.cost import config
from contactgraph_studies.cost.config import CostAmounts, CostCondition, CostTest, Demonstrator
from contactgraph_studies.job import Job, Measurement, Options
from contactgraph_studies.paper.config import StudyTask


@dataclass(frozen=True)
class CostLabels:
    """The labels of a number in ``results.json``."""

    source: str
    task: str
    learned_from: str | None = None
    """None: control with the task's own cost."""
    demonstrations: int | None = None
    distractors: int | None = None
    """Of control."""


def demonstrated(task: StudyTask) -> CostLabels:
    """Control with the task's own cost; these trajectories are demonstrations, too."""
    return CostLabels("control with the task's own cost", task.name)


def learning(task: StudyTask, learned: CostCondition) -> CostLabels:
    """Learning of a cost."""
    return CostLabels("learning", task.name, learned.name, learned.demonstrations)


def control(task: StudyTask, test: CostTest) -> CostLabels:
    """Control with a learned cost."""
    learned = test.learned
    return CostLabels("control", task.name, learned.name, learned.demonstrations, test.distractors)


def cost_measurements(tasks: Sequence[StudyTask], amounts: CostAmounts) -> list[Measurement]:
    """All of the study, seed by seed."""
    return [one for seed in amounts.seeds for task in tasks for one in _of(task, seed, amounts)]


def _of(task: StudyTask, seed: int, amounts: CostAmounts) -> Iterator[Measurement]:
    own = _demonstration_job(task, config.OWN_COST, seed, amounts)
    yield Measurement(demonstrated(task), seed, own)
    for learned in config.learned_costs(task, amounts):
        job = _learning_job(task, learned, seed, amounts)
        yield Measurement(learning(task, learned), seed, job)
    for test in config.tests_of(task, amounts):
        yield Measurement(control(task, test), seed, _test_job(task, test, seed, amounts))


def _demonstration_job(
    task: StudyTask, demonstrator: Demonstrator, seed: int, amounts: CostAmounts
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
    files = ("--json", output, "--save", trajectories)
    arguments = ("control", task.name, task.name, *counts, *scenes, *files)
    return Job(output, arguments, f"control {task.name}", extra_outputs=(trajectories,))


def _learning_job(task: StudyTask, learned: CostCondition, seed: int, amounts: CostAmounts) -> Job:
    """The file of a learned cost."""
    data = _demonstration_job(task, learned.demonstrator, seed, amounts)
    trajectories = data.output.replace(".json", ".h5")
    output = f"cells/{task.name}/seed-{seed}/{learned.slug}/cost.json"
    options = ("--runs", str(learned.demonstrations), *learned.options)
    arguments = ("learn-cost", task.name, trajectories, *options, "--out", output)
    return Job(output, arguments, f"learn-cost {task.name}", (data,))


def _test_job(task: StudyTask, test: CostTest, seed: int, amounts: CostAmounts) -> Job:
    learned = _learning_job(task, test.learned, seed, amounts)
    path = learned.output.replace("cost.json", f"control-{test.distractors}-distractors")
    scenes = _distractors(test.distractors)
    arguments = (
        *("control", task.name, task.name, "--cost", learned.output),
        *("--episodes", str(amounts.episodes), "--seed", str(config.SCENE_SEED + seed)),
        *(*scenes, *test.options, "--json", f"{path}.json"),
    )
    group = " ".join(("control", task.name, *scenes))
    return Job(f"{path}.json", arguments, group, (learned,))


def _distractors(count: int) -> Options:
    return ("--distractors", str(count)) if count else ()
