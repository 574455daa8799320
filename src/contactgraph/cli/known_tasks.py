"""The table of the library's own tasks."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from contactgraph.cli.task_types import AS_TRAINED, THREE_DISTRACTORS, KnownTask, TestCondition
from contactgraph.envs import (
    BilliardsExpert,
    BilliardsTask,
    CarryExpert,
    ChainTask,
    DelayTask,
    DominoesTask,
    DoorExpert,
    DoorTask,
    ForcedPush,
    HandlingPolicy,
    LookAlikesExpert,
    LookAlikesTask,
    MultiPickupTask,
    PickupExpert,
    PickupTask,
    ReleaseTask,
    RestPolicy,
    SpringsTask,
    StackTask,
    StickyExpert,
    StickyTask,
    StrikingPolicy,
    SuctionExpert,
    SuctionTask,
    TossTask,
    UnknownMassTask,
    fetch,
    pusht,
)
from contactgraph.envs.contract import Policy, Task


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


HIDDEN_HOLD_STARTS = 32
"""Where a touch may have to last to become a hold."""


def _hidden_hold(
    make: Callable[..., Task], expert: Callable[..., Policy], summary: str
) -> KnownTask:
    """A task in which geometry does not tell the contact."""
    return KnownTask(
        make,
        expert,
        partial(expert, noise=0.0),
        explorer=HandlingPolicy,
        exploration=0.5,
        starts=HIDDEN_HOLD_STARTS,
        summary=summary,
        conditions=(AS_TRAINED, THREE_DISTRACTORS),
    )


def _fetch(
    name: str, policies: Sequence[Callable[[], Policy]], max_force: float | None, summary: str
) -> KnownTask:
    """An environment of gymnasium-robotics. ``policies``: expert, fixed start and explorer."""
    expert, fixed_start, explorer = policies
    return KnownTask(
        partial(fetch.fetch_task, name),
        expert,
        fixed_start,
        fixed_start,
        explorer,
        horizon=30,
        starts=64,
        max_force=max_force,
        summary=summary,
    )


_PUSHT = KnownTask(
    pusht.pusht_task,
    pusht.pusht_expert,
    pusht.pusht_fixed_start,
    pusht.pusht_fixed_start,
    pusht.pusht_explorer,
    horizon=30,
    starts=64,
    max_force=None,
    summary="an agent pushes a T to a goal (gym-pusht; success by position, at any angle)",
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
    "suction": replace(
        _hidden_hold(
            SuctionTask,
            SuctionExpert,
            "a suction gripper takes an object to a goal and puts it down",
        ),
        starts=0,  # a plan of switches takes none
        max_force=None,
    ),
    "release": _hidden_hold(
        ReleaseTask,
        CarryExpert,
        "a gripper that loses its hold after a hidden time takes an object to a goal",
    ),
    "delay": _hidden_hold(
        DelayTask,
        CarryExpert,
        "a gripper that holds after 0.4 s of touching takes an object to a goal",
    ),
    "sticky": _hidden_hold(
        StickyTask,
        StickyExpert,
        "a gripper finds an object that holds among look-alikes, and takes it to a goal",
    ),
    "look-alikes": _hidden_hold(
        LookAlikesTask,
        LookAlikesExpert,
        "of two look-alikes, one is welded to the table; a gripper holds the other at a goal",
    ),
    "pusht": _PUSHT,
    "pusht-pose": replace(
        _PUSHT,
        make=pusht.pusht_pose_task,
        summary="as pusht, with its own success: the T covers 95 % of its outline at the goal",
    ),
    "fetch-push": _fetch(
        "fetch-push",
        (fetch.push_expert, fetch.push_fixed_start, fetch.push_explorer),
        fetch.MAX_DISPLACEMENT,
        "an arm pushes a block to a goal (gymnasium-robotics, MuJoCo)",
    ),
    "fetch-slide": _fetch(
        "fetch-slide",
        (fetch.slide_expert, fetch.slide_fixed_start, fetch.slide_explorer),
        fetch.MAX_DISPLACEMENT,
        "an arm strikes a puck that slides to a goal beyond its reach (MuJoCo)",
    ),
    "fetch-pick-and-place": _fetch(
        "fetch-pick-and-place",
        (fetch.pick_expert, fetch.pick_fixed_start, fetch.pick_explorer),
        None,
        "an arm grasps a block, lifts it and takes it to a goal in the air (MuJoCo)",
    ),
}
