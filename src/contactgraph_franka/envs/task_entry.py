"""The task `franka` for the entry point group `contactgraph.tasks`; MuJoCo is imported on use."""

from functools import partial

from contactgraph.cli.options import choice
from contactgraph.cli.task_types import (
    KnownTask,
    TaskFactory,
    TaskOptions,
    TestCondition,
)
from contactgraph.data import InvalidInputError
from contactgraph.envs.experts import ExplorationPolicy
from contactgraph_franka.envs.expert import FrankaExpert
from contactgraph_franka.envs.pickup import MAX_FORCE, Grasp


def _factory(options: TaskOptions) -> TaskFactory:
    # This import raises `InvalidInputError` if MuJoCo is missing.
    from contactgraph_franka.envs.franka_task import FrankaTask

    if options.objects not in (None, 1):
        raise InvalidInputError(f"--objects: franka has 1 object, found {options.objects}")
    task = partial(FrankaTask, options.distractors, fixed_seed=options.fixed_seed)
    if options.grasp is None:
        return task
    grasp = choice("--grasp", options.grasp, {each.value: each for each in Grasp})
    return partial(task, grasp=grasp)


def _explorer() -> ExplorationPolicy:
    # For a hand of 4 kg and steps of 0.01 s: the position spreads by 0.1 m on each axis.
    return ExplorationPolicy(deviation=2.0, correlation_steps=25.0, stiffness=20.0, damping=8.0)


FRANKA = KnownTask(
    factory=_factory,
    expert=FrankaExpert,
    demonstrator=partial(FrankaExpert, noise=0.0),
    explorer=_explorer,
    horizon=50,
    max_force=MAX_FORCE,
    summary="a robot arm picks up a block and takes it to a goal (MuJoCo)",
    title="A contact graph that picks things up with an arm",
    conditions=(
        TestCondition("as-trained", "as trained", True),
        TestCondition("5-distractors", "5 distractors", False, distractors=5),
    ),
)
