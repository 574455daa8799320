"""Every task keeps the contract, with the options that change its scenes, and refuses others."""

import numpy as np
import pytest

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs import (
    BilliardsExpert,
    BilliardsTask,
    CarryExpert,
    DoorExpert,
    DoorTask,
    ForcedPush,
    HandlingPolicy,
    MultiPickupTask,
    PickupExpert,
    PickupTask,
    SpringsTask,
    StickyExpert,
    StickyTask,
    SuctionExpert,
    check_task,
)
from contactgraph.envs.exploration import CorrelatedNoise
from contactgraph.envs.registry import task_factory

PLANAR = [
    *[("pickup", {"distractors": count}) for count in (0, 1, 20)],
    *[("multi-pickup", {"objects": n, "distractors": m}) for n, m in ((1, 1), (2, 0), (5, 3))],
    *[("door", {"distractors": count}) for count in (0, 10)],
    *[(name, {"distractors": 1, "fixed_seed": 7}) for name in ("pickup", "multi-pickup", "door")],
    *[("billiards", {"objects": n, "passive": p}) for p in (False, True) for n in (1, 8 - 4 * p)],
    *[
        (name, {"distractors": 3})
        for name in ("suction", "release", "delay", "sticky", "look-alikes")
    ],
    ("suction", {"hidden_switch": True}),
    ("unknown-mass", {"distractors": 3}),
    ("chain", {}),
]
OTHERS = [
    *("springs", "toss", "stack", pytest.param("dominoes", marks=pytest.mark.slow)),
    *("pusht", "pusht-pose", "fetch-push", "fetch-slide", "fetch-pick-and-place"),
]


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize(("name", "options"), PLANAR)
def test_planar_tasks_keep_the_contract_on_each_engine(name: str, options: dict) -> None:
    check_task(task_factory(name, options))


@pytest.mark.parametrize("name", OTHERS)
def test_other_tasks_keep_the_contract(name: str) -> None:
    try:
        factory = task_factory(name, {})
    except InvalidInputError as error:
        pytest.skip(str(error))  # some packages are not to be had everywhere
    check_task(factory)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PickupTask(-1), "distractors must be 0 to 20, found -1"),
        (lambda: PickupTask(21), "distractors must be 0 to 20, found 21"),
        (lambda: PickupTask(1, in_the_way=True), "distractors must be 2 or more to be in the way"),
        (lambda: PickupTask(fixed_seed=-1), "fixed_seed must be at least 0, found -1"),
        (lambda: MultiPickupTask(0), "objects must be 1 to 5, found 0"),
        (lambda: MultiPickupTask(6), "objects must be 1 to 5, found 6"),
        (lambda: DoorTask(-1), "distractors must be 0 to 10, found -1"),
        (lambda: DoorTask(11), "distractors must be 0 to 10, found 11"),
        (lambda: DoorTask(fixed_seed=-1), "fixed_seed must be at least 0, found -1"),
        (lambda: task_factory("franka", {"fixed_seed": -1})(), "fixed_seed must be at least 0, f"),
        (lambda: StickyTask(1), "objects must be 2 to 5, found 1"),
        (lambda: StickyTask(6), "objects must be 2 to 5, found 6"),
        (lambda: BilliardsTask(0), "objects must be 1 to 8, found 0"),
        (lambda: BilliardsTask(9), "objects must be 1 to 8, found 9"),
        (lambda: SpringsTask(1), "objects must be 2 to 20, found 1"),
        (lambda: SpringsTask(21), "objects must be 2 to 20, found 21"),
        (lambda: CorrelatedNoise(-1.0, 2.0), "noise needs deviation >= 0"),
        (lambda: CorrelatedNoise(0.5, 0.0), "noise needs deviation >= 0"),
        (lambda: CorrelatedNoise(np.nan, 2.0), "noise needs deviation >= 0"),
    ],
)
def test_numbers_out_of_range(make, message):
    with pytest.raises(InvalidInputError, match=message):
        make()


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        *((each, "this expert needs a goal") for each in (PickupExpert, SuctionExpert)),
        *((each, "this expert needs a goal") for each in (CarryExpert, StickyExpert)),
        (DoorExpert, "a door expert needs a node 1 with an anchor"),
        (BilliardsExpert, "a billiards expert needs an actuated node 0"),
        (HandlingPolicy, "handling needs an actuated node 0 and a body"),
        (ForcedPush, "needs an actuated node 0 and a control of two"),
    ],
)
def test_policies_refuse_a_scene_without_what_they_need(policy, message):
    alone = Scene(("gripper",), ("gripper",), np.array([True]), 0.05, goal=np.zeros(2))
    with pytest.raises(InvalidInputError, match=message):
        policy().reset(alone, 0)
