"""The table of the library's own tasks."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from contactgraph.cli.adapted_tasks import ADAPTED_TASKS
from contactgraph.cli.hidden_contact_tasks import HIDDEN_CONTACT_TASKS
from contactgraph.cli.task_types import (
    KnownTask,
    TaskFactory,
    TaskOptions,
    TestCondition,
    refuse_option,
    without_options,
)
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
from contactgraph.envs.shaped_tasks import VerticalTask


def _pickup(options: TaskOptions) -> TaskFactory:
    refuse_option("pickup", "--grasp", options.grasp, "has no fingers to close")
    if options.objects != 1:
        refuse_option("pickup", "--objects", options.objects, "has 1 object")
    task = partial(
        PickupTask,
        options.distractors,
        fixed_seed=options.fixed_seed,
        in_the_way=options.in_the_way,
    )
    return task if options.radius is None else partial(task, radius=options.radius)


def _multi_pickup(options: TaskOptions) -> TaskFactory:
    refuse_option("multi-pickup", "--grasp", options.grasp, "has no fingers to close")
    task = MultiPickupTask if options.objects is None else partial(MultiPickupTask, options.objects)
    return partial(task, distractors=options.distractors, fixed_seed=options.fixed_seed)


def _door(options: TaskOptions) -> TaskFactory:
    refuse_option("door", "--grasp", options.grasp, "has no fingers to close")
    refuse_option("door", "--objects", options.objects, "has no objects to count")
    return partial(DoorTask, options.distractors, fixed_seed=options.fixed_seed)


def _billiards(options: TaskOptions) -> TaskFactory:
    refuse_option("billiards", "--grasp", options.grasp, "has no fingers to close")
    distractors = options.distractors or None
    refuse_option("billiards", "--distractors", distractors, "counts its discs by --objects")
    task = BilliardsTask if options.objects is None else partial(BilliardsTask, options.objects)
    return partial(task, passive=options.passive, fixed_seed=options.fixed_seed)


def _springs(options: TaskOptions) -> TaskFactory:
    make = SpringsTask if options.objects is None else partial(SpringsTask, options.objects)
    others = replace(options, objects=None)
    return without_options("springs", make, "takes no option but --objects", others)


def _unknown_mass(options: TaskOptions) -> TaskFactory:
    refuse_option("unknown-mass", "--grasp", options.grasp, "has no fingers to close")
    refuse_option("unknown-mass", "--objects", options.objects, "has 1 target")
    return partial(UnknownMassTask, options.distractors, fixed_seed=options.fixed_seed)


def _alone(task: type[VerticalTask], options: TaskOptions) -> TaskFactory:
    return without_options(task.name, task, "takes no options", options)


def _passive(factory: Callable[[TaskOptions], TaskFactory], summary: str) -> KnownTask:
    """A task in which nothing is driven."""
    return KnownTask(
        factory,
        RestPolicy,
        RestPolicy,
        explorer=RestPolicy,
        passive=True,
        max_force=None,
        summary=summary,
    )


TASKS = {
    "pickup": KnownTask(
        _pickup,
        PickupExpert,
        partial(PickupExpert, noise=0.0),
        summary="a gripper picks up an object and takes it to a goal",
        title="A contact graph that picks things up",
        conditions=(
            TestCondition("as-trained", "as trained", True),
            TestCondition("3-distractors", "3 distractors", False, distractors=3, extra=True),
            TestCondition("10-distractors", "10 distractors", False, distractors=10),
        ),
    ),
    "multi-pickup": KnownTask(
        _multi_pickup,
        PickupExpert,
        partial(PickupExpert, noise=0.0),
        summary="a gripper picks up objects in turn and takes them to a goal",
        title="A contact graph that picks up one thing after another",
        conditions=(
            TestCondition("as-trained", "as trained, 2 picks", True),
            TestCondition("5-picks", "5 picks", False, objects=5),
        ),
    ),
    "door": KnownTask(
        _door,
        DoorExpert,
        partial(DoorExpert, noise=0.0),
        summary="a gripper opens a hinged door to an angle",
        title="A contact graph that opens doors",
        conditions=(
            TestCondition("as-trained", "as trained", True),
            TestCondition("10-doors", "10 more doors", False, distractors=10),
        ),
    ),
    "billiards": KnownTask(
        _billiards,
        BilliardsExpert,
        partial(BilliardsExpert, noise=0.0),
        partial(BilliardsExpert, noise=0.0),
        StrikingPolicy,
        horizon=60,
        starts=64,
        passive=True,
        summary="a cue strikes a disc to a goal, on a table with walls, pillars and other discs",
        title="A contact graph that plays billiards",
        conditions=(
            TestCondition("as-trained", "as trained", True),
            TestCondition("6-objects", "6 objects", False, objects=6),
        ),
    ),
    "toss": _passive(partial(_alone, TossTask), "a box is tossed onto the floor (MuJoCo)"),
    "dominoes": _passive(
        partial(_alone, DominoesTask), "a row of ten dominoes falls, as far as it does (MuJoCo)"
    ),
    "stack": _passive(partial(_alone, StackTask), "three boxes stand on one another (MuJoCo)"),
    "chain": KnownTask(
        partial(without_options, "chain", ChainTask, "takes no options"),
        PickupExpert,
        partial(PickupExpert, noise=0.0),
        summary="a gripper drags two links, joined by a hinge, to a goal",
        title="A contact graph that drags a chain",
    ),
    "unknown-mass": KnownTask(
        _unknown_mass,
        ForcedPush,
        partial(ForcedPush, noise=0.0, variety=0.0),
        partial(ForcedPush, noise=0.0, variety=0.0),
        partial(ForcedPush, random=True),
        horizon=30,
        starts=64,
        summary="a pusher moves a block of unknown mass to a goal",
        title="A contact graph that pushes blocks of unknown mass",
        conditions=(
            TestCondition("as-trained", "as trained", True),
            TestCondition("3-distractors", "3 distractors", False, distractors=3),
        ),
    ),
    "springs": _passive(_springs, "bodies on springs that nothing shows; nothing is driven"),
    **HIDDEN_CONTACT_TASKS,
    **ADAPTED_TASKS,
}
