"""The entry of a task: how it is made, its policies and test conditions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from operator import ne
from typing import Any

from contactgraph.data import Scene
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


_SERVOS = {"position", "displacement", "velocity"}
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
    horizon: int | None = None
    """Default planning horizon, steps. None: see `planning`."""
    starts: int | None = None
    """Starts that plans are searched from by default. None: see `planning`."""
    max_force: float | None = MAX_FORCE
    """Bound of the control on each axis, N."""
    passive: bool = False
    """Whether it moves without a control, or can."""
    summary: str = ""
    """One line for the list of tasks and the title of a report."""
    conditions: tuple[TestCondition, ...] = (AS_TRAINED,)
    """Test conditions: the one in distribution first, the hardest last."""

    @classmethod
    def of_class(cls, task: type) -> "KnownTask":
        """The task of a class; its attributes of these names are its fields.

        What a class does not name has the defaults of this table; its ``expert`` explores, and its
        ``demonstrator`` is the expert.
        """
        given = {
            each.name: getattr(task, each.name) for each in fields(cls) if hasattr(task, each.name)
        }
        expert = given.setdefault("expert", ExplorationPolicy)
        return cls(**{"demonstrator": expert, "max_force": None, **given, "make": task})

    def planning(self, scene: Scene) -> tuple[int, int, str]:
        """Horizon [steps] and starts of plans in a scene, and why.

        What is not given follows from what is controlled: a servo, or a displacement, pushes and
        cannot pull, so a plan is long and begins with a search for the side to push from. Forces
        act on what is touched and held, where iLQR needs neither.
        """
        kinds = sorted(_SERVOS & set(scene.control_kind or ()))
        reason = f"the control is a {kinds[0]}" if kinds else "the control is a force"
        horizon = (30 if kinds else 20) if self.horizon is None else self.horizon
        starts = (64 if kinds else 0) if self.starts is None else self.starts
        if self.horizon is not None and self.starts is not None:
            reason = "the task says so"
        return horizon, starts, reason
