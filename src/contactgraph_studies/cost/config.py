"""Configuration of the study of learned costs. Tasks are controlled with their shipped models."""

from dataclasses import dataclass

from contactgraph_studies.job import Options
from contactgraph_studies.paper.config import DOOR, MULTI_PICKUP, PICKUP, TEST_SEED, StudyTask


@dataclass(frozen=True)
class Demonstrator:
    """A policy that demonstrates a task."""

    slug: str
    """Part of file names."""
    name: str
    distractors: int = 0
    """Distractors in the demonstrated scenes."""
    planned: bool = False
    """MPC, with another goal in every demonstration; else the task's expert, always with the same
    goal and objects."""


@dataclass(frozen=True)
class CostCondition:
    """One way to learn a cost."""

    slug: str
    """Folder name."""
    name: str
    demonstrator: Demonstrator
    demonstrations: int
    options: Options = ()
    """Options of ``learn-cost``."""


@dataclass(frozen=True)
class CostTest:
    """Control with a learned cost, in scenes whose goal and objects were not demonstrated."""

    learned: CostCondition
    distractors: int = 0
    options: Options = ()
    """Options of ``control``."""


@dataclass(frozen=True)
class CostAmounts:
    """Numbers of seeds, demonstrations and episodes."""

    seeds: tuple[int, ...]
    """Of demonstrations; each seed has its own goal and objects."""
    demonstrations: tuple[int, ...]
    """In ascending order."""
    episodes: int
    """For each seed and test."""

    @property
    def most(self) -> int:
        """The number of recorded demonstrations."""
        return self.demonstrations[-1]


SCENE_SEED = TEST_SEED + 100
"""Test scenes have this seed plus that of the demonstrations: different for every seed, so that all
seeds may be pooled, and the same for every test. No model and no other study uses them."""
DISTRACTORS = 5
LOOK_AHEAD = 20
"""Steps that the learner looks ahead in these tasks."""

EXPERT = Demonstrator("expert", "expert")
EXPERT_AMONG = Demonstrator(
    "expert-among-5", f"expert among {DISTRACTORS} distractors", distractors=DISTRACTORS
)
OWN_COST = Demonstrator("own-cost", "MPC with the task's own cost", planned=True)
COST_TASKS = (PICKUP, MULTI_PICKUP, DOOR)

FULL_COST = CostAmounts((0, 1, 2), (5, 10, 20, 40), 100)
QUICK_COST = CostAmounts((0,), (5, 40), 10)


def by_demonstrations(amounts: CostAmounts) -> list[CostTest]:
    """Learned from the expert; tested without distractors."""
    return [CostTest(_learned(EXPERT, count)) for count in amounts.demonstrations]


def among_distractors(amounts: CostAmounts) -> list[CostTest]:
    """Tested with distractors; learned without and with others."""
    return [CostTest(_learned(one, amounts.most), DISTRACTORS) for one in (EXPERT, EXPERT_AMONG)]


def known_answer(amounts: CostAmounts) -> CostCondition:
    """Learned from MPC with the task's own cost."""
    return _learned(OWN_COST, amounts.most)


def without_prior(amounts: CostAmounts) -> CostTest:
    """Learned from the expert without the prior towards independent cost terms."""
    slug, name = f"{EXPERT.slug}-{amounts.most}-no-prior", f"{EXPERT.name}, without the prior"
    return CostTest(CostCondition(slug, name, EXPERT, amounts.most, ("--prior-weight", "0")))


def without_contacts(amounts: CostAmounts) -> CostTest:
    """Learned from the expert without what contacts are worth; planned as far as with it."""
    slug, name = f"{EXPERT.slug}-{amounts.most}-no-contacts", f"{EXPERT.name}, without contacts"
    learned = CostCondition(slug, name, EXPERT, amounts.most, ("--without-contacts",))
    return CostTest(learned, options=("--horizon", str(LOOK_AHEAD)))


def tests_of(task: StudyTask, amounts: CostAmounts) -> list[CostTest]:
    """All tests of a task, in the order of the table."""
    own = CostTest(known_answer(amounts))
    every = [*by_demonstrations(amounts), *among_distractors(amounts), own]
    every.append(without_contacts(amounts))
    return [*every, without_prior(amounts)] if task is PICKUP else every


def learned_costs(task: StudyTask, amounts: CostAmounts) -> list[CostCondition]:
    """All costs that are learned for a task."""
    return list(dict.fromkeys(test.learned for test in tests_of(task, amounts)))


def _learned(demonstrator: Demonstrator, count: int) -> CostCondition:
    return CostCondition(f"{demonstrator.slug}-{count}", demonstrator.name, demonstrator, count)
