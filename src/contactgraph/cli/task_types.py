"""The entry of a task: how it is made, its policies and test conditions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from operator import ne
from typing import Any

from contactgraph.envs import ExplorationPolicy
from contactgraph.envs.contract import Policy, Task
from contactgraph.envs.gripper_task import MAX_FORCE

FLAGS = (
    *("distractors", "objects", "grasp", "radius", "passive", "hidden_switch"),
    *("in_the_way", "engine"),
)
"""Arguments of tasks that are flags of the commands; ``fixed_seed`` is ``--goal fixed``."""


def given_options(command: Any) -> dict[str, Any]:
    """The options of a command's scenes that differ from its defaults, by name."""
    values = {each.name: (getattr(command, each.name), each.default) for each in fields(command)}
    return {name: values[name][0] for name in FLAGS if name in values and ne(*values[name])}


def options_metadata(options: Mapping[str, Any]) -> dict[str, str | int | float]:
    """The options of scenes, for the metadata of written files."""
    goal = {} if options.get("fixed_seed") is None else {"goal": "fixed"}
    named = {name: value for name, value in options.items() if name in FLAGS and name != "engine"}
    return {"distractors": 0, **named, **goal}


@dataclass(frozen=True)
class TestCondition:
    """Scenes that models are tested in."""

    __test__ = False  # pytest collects every class whose name begins with Test

    slug: str
    """Part of file names."""
    name: str
    in_distribution: bool
    """Whether models are trained on such scenes."""
    distractors: int = 0
    objects: int | None = None
    """None: the task's default."""
    extra: bool = False
    """Whether a quick study leaves the condition out."""

    @property
    def options(self) -> tuple[str, ...]:
        """The options of ``collect`` and ``control`` for these scenes."""
        distractors = ("--distractors", str(self.distractors)) if self.distractors else ()
        objects = () if self.objects is None else ("--objects", str(self.objects))
        return (*distractors, *objects)


AS_TRAINED = TestCondition("as-trained", "as trained", True)
THREE_DISTRACTORS = TestCondition("3-distractors", "3 distractors", False, distractors=3)
TaskFactory = Callable[[], Task]


@dataclass(frozen=True)
class KnownTask:
    """A task that has a name on the command line."""

    make: Callable[..., Task]
    """The task's class, or a function; its arguments are the options of the task's scenes."""
    expert: Callable[[], Policy]
    """Makes the policy to train on: noise on its force distinguishes mass from damping."""
    demonstrator: Callable[[], Policy]
    """Makes the same policy without noise."""
    fixed_start: Callable[[], Policy] | None = None
    """Makes the scripted controller without model or search that plans are compared with."""
    explorer: Callable[[], Policy] = ExplorationPolicy
    exploration: float = 0.0
    """Default share of recorded episodes by the explorer: more than 0 where the expert sees what
    its commands would otherwise tell a model, such as a hidden hold."""
    horizon: int = 20
    """Default planning horizon, steps."""
    starts: int = 0
    """Starts that plans are searched from by default; where what is touched is held, iLQR needs
    none."""
    max_force: float | None = MAX_FORCE
    """Bound of the control on each axis, N."""
    passive: bool = False
    """Whether it moves without a control, or can."""
    summary: str = ""
    """One line for the list of tasks and the title of a report."""
    conditions: tuple[TestCondition, ...] = (AS_TRAINED,)
    """Test conditions: the one in distribution first, the hardest last."""
