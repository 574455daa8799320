"""The table of the tasks in which geometry does not tell the contact."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from contactgraph.cli.task_types import AS_TRAINED, THREE_DISTRACTORS, KnownTask
from contactgraph.envs import (
    CarryExpert,
    DelayTask,
    HandlingPolicy,
    LookAlikesExpert,
    LookAlikesTask,
    ReleaseTask,
    StickyExpert,
    StickyTask,
    SuctionExpert,
    SuctionTask,
)
from contactgraph.envs.contract import Policy, Task


def _task(make: Callable[..., Task], expert: Callable[..., Policy], summary: str) -> KnownTask:
    return KnownTask(
        make,
        expert,
        partial(expert, noise=0.0),
        explorer=HandlingPolicy,
        exploration=0.5,
        summary=summary,
        conditions=(AS_TRAINED, THREE_DISTRACTORS),
    )


HIDDEN_CONTACT_TASKS = {
    "suction": replace(
        _task(
            SuctionTask,
            SuctionExpert,
            "a suction gripper takes an object to a goal and puts it down",
        ),
        max_force=None,
    ),
    "release": _task(
        ReleaseTask,
        CarryExpert,
        "a gripper that loses its hold after a hidden time takes an object to a goal",
    ),
    "delay": _task(
        DelayTask,
        CarryExpert,
        "a gripper that holds after 0.4 s of touching takes an object to a goal",
    ),
    "sticky": _task(
        StickyTask,
        StickyExpert,
        "a gripper finds an object that holds among look-alikes, and takes it to a goal",
    ),
    "look-alikes": _task(
        LookAlikesTask,
        LookAlikesExpert,
        "of two look-alikes, one is welded to the table; a gripper holds the other at a goal",
    ),
}
