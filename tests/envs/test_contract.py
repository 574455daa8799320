"""Every task of the library keeps the contract, with the options that change its scenes."""

import pytest

from contactgraph.cli.tasks import task_factory
from contactgraph.data import InvalidInputError
from contactgraph.envs import check_task

PLANAR = [
    *[("pickup", {"distractors": count}) for count in (0, 1, 20)],
    *[("multi-pickup", {"objects": n, "distractors": m}) for n, m in ((1, 1), (2, 0), (5, 3))],
    *[("door", {"distractors": count}) for count in (0, 10)],
    *[(name, {"distractors": 1, "fixed_seed": 7}) for name in ("pickup", "multi-pickup", "door")],
    *[("billiards", {"objects": n, "passive": p}) for p in (False, True) for n in (1, 8 - 4 * p)],
    *[(name, {"distractors": 3}) for name in ("suction", "release", "delay", "sticky")],
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
