"""What the study of learned costs measures: tasks, ways of learning, test scenes, how much."""

from collections.abc import Callable
from dataclasses import dataclass

from contactgraph.envs import DoorTask, MultiPickupTask, PickupTask
from contactgraph.envs.contract import Task
from contactgraph_studies.declared import DOOR, MULTI_PICKUP, PICKUP, TEST_SEED, Options


@dataclass(frozen=True)
class CostTask:
    """A task, with the model of the same name that comes with the package."""

    name: str
    task: Callable[[], Task]
    without_prior: bool = False
    """Whether learning without the prior is measured, too."""


@dataclass(frozen=True)
class Demonstrator:
    """Who demonstrates, and where."""

    slug: str
    """Names files."""
    name: str
    distractors: int = 0
    """In view while it demonstrates."""
    planned: bool = False
    """By MPC, every run with a goal of its own; else by the task's expert, all runs with one goal
    and the same objects."""
    hidden: "Lesson | None" = None
    """Where MPC's cost was learned; None: it is the task's own."""


@dataclass(frozen=True)
class Lesson:
    """One way to learn a cost."""

    slug: str
    """Names folders."""
    name: str
    demonstrator: Demonstrator
    runs: int
    """Demonstrations."""
    options: Options = ()
    """Of ``learn-cost``."""


@dataclass(frozen=True)
class Trial:
    """A learned cost put to the test, in scenes whose goal and objects it has not seen."""

    lesson: Lesson
    distractors: int = 0
    """In view."""


@dataclass(frozen=True)
class CostAmounts:
    """How much of everything."""

    seeds: tuple[int, ...]
    """Of demonstrations: each has a goal and objects of its own."""
    runs: tuple[int, ...]
    """Demonstrations learned from, fewest first."""
    episodes: int
    """A seed and trial."""

    @property
    def most(self) -> int:
        """As many are recorded."""
        return self.runs[-1]


SCENE_SEED = TEST_SEED + 100
"""Test scenes are of this seed plus that of the demonstrations: other ones for every seed, so that
those of all seeds may be counted together, and the same ones for every trial. No other study
and no model has seen them."""
BYSTANDERS = 5
"""Distractors in view."""

LEARNED_AHEAD = 20
"""Steps that the learner looks ahead in these tasks."""

EXPERT = Demonstrator("expert", "expert")
EXPERT_AMONG = Demonstrator(
    "expert-among-5", f"expert among {BYSTANDERS} distractors", distractors=BYSTANDERS
)
OWN_COST = Demonstrator("own-cost", "MPC with the task's own cost", planned=True)

PICKUP_COST = CostTask(PICKUP.name, PickupTask, without_prior=True)
MULTI_PICKUP_COST = CostTask(MULTI_PICKUP.name, MultiPickupTask)
DOOR_COST = CostTask(DOOR.name, DoorTask)
COST_TASKS = (PICKUP_COST, MULTI_PICKUP_COST, DOOR_COST)

FULL_COST = CostAmounts((0, 1, 2), (5, 10, 20, 40), 100)
QUICK_COST = CostAmounts((0,), (5, 40), 10)


def by_runs(amounts: CostAmounts) -> list[Trial]:
    """Learned from so many runs of the expert; tested without distractors."""
    return [Trial(_lesson(EXPERT, runs)) for runs in amounts.runs]


def among_distractors(amounts: CostAmounts) -> list[Trial]:
    """Controlled with distractors: learned without, and with others in view."""
    return [
        Trial(_lesson(demonstrator, amounts.most), BYSTANDERS)
        for demonstrator in (EXPERT, EXPERT_AMONG)
    ]


def known_answers(amounts: CostAmounts) -> tuple[Lesson, Lesson]:
    """Learned from runs of MPC with a cost that is known: the task's own, and a learned one.

    The task's own asks for more force than there is, and where it does it is not seen; a cost
    that was learned from an expert hardly ever does.
    """
    learned = _lesson(EXPERT, amounts.most)
    name = "MPC with the cost learned from the expert"
    again = Demonstrator("learned-cost", name, planned=True, hidden=learned)
    return _lesson(OWN_COST, amounts.most), _lesson(again, amounts.most)


def without_prior(amounts: CostAmounts) -> Trial:
    """Learned from what the expert's runs say, and nothing else."""
    learned = _lesson(EXPERT, amounts.most)
    options = ("--prior-weight", "0")
    name = f"{learned.name}, without the prior"
    return Trial(Lesson(f"{learned.slug}-no-prior", name, EXPERT, amounts.most, options))


def trials(task: CostTask, amounts: CostAmounts) -> list[Trial]:
    """All of a task, in the order of the table."""
    found = [*by_runs(amounts), *among_distractors(amounts), Trial(known_answers(amounts)[0])]
    return [*found, without_prior(amounts)] if task.without_prior else found


def lessons(task: CostTask, amounts: CostAmounts) -> list[Lesson]:
    """All costs that are learned of a task."""
    tested = [trial.lesson for trial in trials(task, amounts)]
    return list(dict.fromkeys([*tested, *known_answers(amounts)]))


def _lesson(demonstrator: Demonstrator, runs: int) -> Lesson:
    return Lesson(f"{demonstrator.slug}-{runs}", demonstrator.name, demonstrator, runs)
