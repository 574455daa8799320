"""The table of the library's own tasks."""

from collections.abc import Callable
from functools import partial

from contactgraph.cli.adapted_tasks import ADAPTED_TASKS
from contactgraph.cli.hidden_contact_tasks import HIDDEN_CONTACT_TASKS
from contactgraph.cli.task_types import AS_TRAINED, THREE_DISTRACTORS, KnownTask, TestCondition
from contactgraph.envs import (
    BilliardsExpert,
    BilliardsTask,
    ChainTask,
    DominoesTask,
    DoorExpert,
    DoorTask,
    ForcedPush,
    MultiPickupTask,
    PickupExpert,
    PickupTask,
    RestPolicy,
    SpringsTask,
    StackTask,
    StrikingPolicy,
    TossTask,
    UnknownMassTask,
)
from contactgraph.envs.contract import Task


def _passive(make: Callable[[], Task], summary: str) -> KnownTask:
    """A task in which nothing is driven."""
    return KnownTask(
        make,
        RestPolicy,
        RestPolicy,
        explorer=RestPolicy,
        passive=True,
        max_force=None,
        summary=summary,
    )


TASKS = {
    "pickup": KnownTask(
        PickupTask,
        PickupExpert,
        partial(PickupExpert, noise=0.0),
        summary="a gripper picks up an object and takes it to a goal",
        conditions=(
            AS_TRAINED,
            TestCondition("3-distractors", "3 distractors", False, distractors=3, extra=True),
            TestCondition("10-distractors", "10 distractors", False, distractors=10),
        ),
    ),
    "multi-pickup": KnownTask(
        MultiPickupTask,
        PickupExpert,
        partial(PickupExpert, noise=0.0),
        summary="a gripper picks up objects in turn and takes them to a goal",
        conditions=(
            TestCondition("as-trained", "as trained, 2 picks", True),
            TestCondition("5-picks", "5 picks", False, objects=5),
        ),
    ),
    "door": KnownTask(
        DoorTask,
        DoorExpert,
        partial(DoorExpert, noise=0.0),
        summary="a gripper opens a hinged door to an angle",
        conditions=(
            AS_TRAINED,
            TestCondition("10-doors", "10 more doors", False, distractors=10),
        ),
    ),
    "billiards": KnownTask(
        BilliardsTask,
        BilliardsExpert,
        partial(BilliardsExpert, noise=0.0),
        partial(BilliardsExpert, noise=0.0),
        StrikingPolicy,
        horizon=60,
        starts=64,
        passive=True,
        summary="a cue strikes a disc to a goal, on a table with walls, pillars and other discs",
        conditions=(
            AS_TRAINED,
            TestCondition("6-objects", "6 objects", False, objects=6),
        ),
    ),
    "toss": _passive(TossTask, "a box is tossed onto the floor (MuJoCo)"),
    "dominoes": _passive(DominoesTask, "a row of ten dominoes falls, as far as it does (MuJoCo)"),
    "stack": _passive(StackTask, "three boxes stand on one another (MuJoCo)"),
    "chain": KnownTask(
        ChainTask,
        PickupExpert,
        partial(PickupExpert, noise=0.0),
        summary="a gripper drags two links, joined by a hinge, to a goal",
    ),
    "unknown-mass": KnownTask(
        UnknownMassTask,
        ForcedPush,
        partial(ForcedPush, noise=0.0, variety=0.0),
        partial(ForcedPush, noise=0.0, variety=0.0),
        partial(ForcedPush, random=True),
        horizon=30,
        starts=64,
        summary="a pusher moves a block of unknown mass to a goal",
        conditions=(AS_TRAINED, THREE_DISTRACTORS),
    ),
    "springs": _passive(SpringsTask, "bodies on springs that nothing shows; nothing is driven"),
    **HIDDEN_CONTACT_TASKS,
    **ADAPTED_TASKS,
}
