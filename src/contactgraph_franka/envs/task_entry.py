"""The task `franka` for the entry point group `contactgraph.tasks`; MuJoCo is imported on use."""

from functools import partial
from typing import TYPE_CHECKING

from contactgraph.cli.options import choice
from contactgraph.cli.task_types import AS_TRAINED, KnownTask, TestCondition
from contactgraph.envs.exploration import ExplorationPolicy
from contactgraph_franka.envs.expert import FrankaExpert
from contactgraph_franka.envs.pickup import MAX_FORCE, Grasp

if TYPE_CHECKING:
    from contactgraph_franka.envs.franka_task import FrankaTask


def franka_task(
    distractors: int = 0, grasp: str | None = None, fixed_seed: int | None = None
) -> "FrankaTask":
    """The arm's task; ``grasp`` is friction (default) or weld.

    Raises `InvalidInputError` if MuJoCo is missing, and for another grasp.
    """
    from contactgraph_franka.envs.franka_task import FrankaTask

    grasps = {each.value: each for each in Grasp}
    chosen = Grasp.FRICTION if grasp is None else choice("--grasp", grasp, grasps)
    return FrankaTask(distractors, chosen, fixed_seed=fixed_seed)


def _explorer() -> ExplorationPolicy:
    # For a hand of 4 kg and steps of 0.01 s: the position spreads by 0.1 m on each axis.
    return ExplorationPolicy(deviation=2.0, correlation_steps=25.0, stiffness=20.0, damping=8.0)


FRANKA = KnownTask(
    make=franka_task,
    expert=FrankaExpert,
    demonstrator=partial(FrankaExpert, noise=0.0),
    explorer=_explorer,
    horizon=50,
    max_force=MAX_FORCE,
    summary="a robot arm picks up a block and takes it to a goal (MuJoCo)",
    conditions=(
        AS_TRAINED,
        TestCondition("5-distractors", "5 distractors", False, distractors=5),
    ),
)
