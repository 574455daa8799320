"""The table of the tasks in which geometry does not tell holding."""

from functools import partial

from contactgraph.cli.task_types import KnownTask, TestCondition
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


HIDDEN_CONTACT_TASKS = {
    "suction": KnownTask(
        SuctionTask,
        SuctionExpert,
        partial(SuctionExpert, noise=0.0),
        explorer=HandlingPolicy,
        max_force=None,
        summary="a suction gripper takes an object to a goal and puts it down",
        title="A contact graph that knows when a gripper sucks",
        conditions=_CONDITIONS,
    ),
    "release": KnownTask(
        ReleaseTask,
        CarryExpert,
        partial(CarryExpert, noise=0.0),
        explorer=HandlingPolicy,
        summary="a gripper that loses its hold after a hidden time takes an object to a goal",
        title="A contact graph that notices a lost hold",
        conditions=_CONDITIONS,
    ),
    "delay": KnownTask(
        DelayTask,
        CarryExpert,
        partial(CarryExpert, noise=0.0),
        explorer=HandlingPolicy,
        summary="a gripper that holds after 0.4 s of touching takes an object to a goal",
        title="A contact graph that waits for a hold",
        conditions=_CONDITIONS,
    ),
    "sticky": KnownTask(
        StickyTask,
        StickyExpert,
        partial(StickyExpert, noise=0.0),
        explorer=HandlingPolicy,
        summary="a gripper finds an object that holds among look-alikes, and takes it to a goal",
        title="A contact graph that finds out which objects hold",
        conditions=_CONDITIONS,
    ),
}
