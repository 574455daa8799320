"""The table of the tasks in which geometry does not tell holding."""

from functools import partial

from contactgraph.cli.task_types import (
    KnownTask,
    TaskFactory,
    TaskOptions,
    TestCondition,
    refuse_option,
)
from contactgraph.envs import (
    CarryExpert,
    DelayTask,
    HandlingPolicy,
    ReleaseTask,
    StickyExpert,
    StickyTask,
    SuctionExpert,
    SuctionTask,
)

_CONDITIONS = (
    TestCondition("as-trained", "as trained", True),
    TestCondition("3-distractors", "3 distractors", False, distractors=3),
)


def _suction(options: TaskOptions) -> TaskFactory:
    _refuse("suction", options)
    task = partial(SuctionTask, options.distractors, fixed_seed=options.fixed_seed)
    return partial(task, hidden_switch=options.hidden_switch, lose_grasp=options.lose_grasp)


def _one_target(
    name: str, task: type[ReleaseTask] | type[DelayTask], options: TaskOptions
) -> TaskFactory:
    _refuse(name, options)
    return partial(task, options.distractors, fixed_seed=options.fixed_seed)


def _sticky(options: TaskOptions) -> TaskFactory:
    refuse_option("sticky", "--grasp", options.grasp, "has no fingers to close")
    task = StickyTask if options.objects is None else partial(StickyTask, options.objects)
    return partial(task, distractors=options.distractors, fixed_seed=options.fixed_seed)


def _refuse(name: str, options: TaskOptions) -> None:
    refuse_option(name, "--grasp", options.grasp, "has no fingers to close")
    if options.objects != 1:
        refuse_option(name, "--objects", options.objects, "has 1 object")


HIDDEN_CONTACT_TASKS = {
    "suction": KnownTask(
        _suction,
        SuctionExpert,
        partial(SuctionExpert, noise=0.0),
        explorer=HandlingPolicy,
        max_force=None,
        summary="a suction gripper takes an object to a goal and puts it down",
        title="A contact graph that knows when a gripper sucks",
        conditions=_CONDITIONS,
    ),
    "release": KnownTask(
        partial(_one_target, "release", ReleaseTask),
        CarryExpert,
        partial(CarryExpert, noise=0.0),
        explorer=HandlingPolicy,
        summary="a gripper that loses its hold after a hidden time takes an object to a goal",
        title="A contact graph that notices a lost hold",
        conditions=_CONDITIONS,
    ),
    "delay": KnownTask(
        partial(_one_target, "delay", DelayTask),
        CarryExpert,
        partial(CarryExpert, noise=0.0),
        explorer=HandlingPolicy,
        summary="a gripper that holds after 0.4 s of touching takes an object to a goal",
        title="A contact graph that waits for a hold",
        conditions=_CONDITIONS,
    ),
    "sticky": KnownTask(
        _sticky,
        StickyExpert,
        partial(StickyExpert, noise=0.0),
        explorer=HandlingPolicy,
        summary="a gripper finds an object that holds among look-alikes, and takes it to a goal",
        title="A contact graph that finds out which objects hold",
        conditions=_CONDITIONS,
    ),
}
