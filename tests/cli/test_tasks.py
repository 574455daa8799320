"""Tasks by name: the library's, those of other packages, and classes named module:Class."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from contactgraph.cli import main as cli
from contactgraph.cli.task_types import TaskOptions
from contactgraph.cli.tasks import known_task, task_factory, task_names
from contactgraph.data import InvalidInputError, read_trajectories

EXAMPLES = Path(__file__).parents[2] / "examples"
LINE = "extend_task:Line"


@pytest.fixture
def in_examples(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The folder of the examples as the current one, whose modules can be named."""
    monkeypatch.chdir(EXAMPLES)
    yield
    sys.modules.pop("extend_task", None)


def test_names_are_listed_without_an_import(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.EntryPoint.load", lambda entry: pytest.fail("loaded"))
    assert task_names() == (
        "pickup",
        "multi-pickup",
        "door",
        "billiards",
        "toss",
        "dominoes",
        "stack",
        "chain",
        "unknown-mass",
        "springs",
        "suction",
        "release",
        "delay",
        "sticky",
        "pusht",
        "pusht-pose",
        "fetch-push",
        "fetch-slide",
        "fetch-pick-and-place",
        "franka",
    )


def test_a_task_of_another_package_comes_by_its_entry_point() -> None:
    franka = known_task("franka")
    assert (franka.horizon, franka.max_force, len(franka.conditions)) == (50, 20.0, 2)


def test_collect_and_control_take_a_class(
    in_examples: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "line.h5"
    options = ["--episodes", "3", "--distractors", "1", "--mixed", "--exploration", "0.34"]
    assert cli.run(["collect", LINE, *options, "--out", str(path)]) == 0
    dataset = read_trajectories(path)
    assert dataset.metadata == {"task": LINE, "seed": 0, "distractors": 1, "mixed": True}
    assert [each.scene.node_count for each in dataset] == [2, 3, 2]
    policies = [each.scene.metadata["policy"] for each in dataset]
    assert policies == ["PickupExpert", "PickupExpert", "ExplorationPolicy"]
    calls = []

    def stop(model, factory, *arguments, **options):
        calls.append((type(factory()).__name__, options["horizon"]))
        raise KeyboardInterrupt

    monkeypatch.setattr("contactgraph.evaluate.control_task", stop)
    assert cli.run(["control", "pickup", LINE, "--distractors", "1"]) == 130
    assert calls == [("Line", 20)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (TaskOptions(objects=2), "--objects: extend_task:Line takes no argument 'objects', found "),
        (TaskOptions(fixed_seed=3), "--goal: extend_task:Line takes no argument 'fixed_seed', f"),
        (TaskOptions(radius=0.1), "--radius: extend_task:Line takes no argument 'radius', found "),
    ],
)
def test_options_that_a_class_does_not_take(
    in_examples: None, options: TaskOptions, message: str
) -> None:
    with pytest.raises(InvalidInputError, match=f"^{message}"):
        task_factory(LINE, options)


def test_collect_without_a_cue(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "passive.h5"
    command = ["collect", "billiards", "--passive", "--objects", "4", "--out", str(path)]
    assert cli.run([*command, "--episodes", "2"]) == 0
    assert "expert" not in capsys.readouterr().out
    dataset = read_trajectories(path)
    assert dataset.metadata["passive"] is True
    for each in dataset:
        assert each.control.shape == (80, 0) and each.scene.metadata["policy"] == "RestPolicy"
        assert each.scene.static is not None and each.scene.planes is not None
    for wrong in (["--exploration", "0.2"], ["--expert", "demo"]):
        assert cli.run([*command, *wrong]) == 2
        assert "--passive: nothing is driven" in capsys.readouterr().err


def test_what_always_moves_by_itself_needs_no_option(tmp_path: Path) -> None:
    command = ["collect", "stack", "--episodes", "2", "--out"]
    assert cli.run([*command, str(tmp_path / "one.h5"), "--passive"]) == 0
    assert cli.run([*command, str(tmp_path / "other.h5")]) == 0
    one, other = (read_trajectories(tmp_path / name) for name in ("one.h5", "other.h5"))
    for each, same in zip(one, other, strict=True):
        assert each.control.shape == (100, 0) and each.orientation is not None
        assert each.scene.polygons is not None and each.angular_velocity is not None
        assert (each.position == same.position).all()
    first, second = one
    assert (first.position[0] != second.position[0]).any()


def test_what_can_be_passive() -> None:
    names = "billiards, toss, dominoes, stack, springs"
    message = f"^--passive: only {names} move without a control, found door"
    with pytest.raises(InvalidInputError, match=message):
        task_factory("door", TaskOptions(passive=True))
    with pytest.raises(InvalidInputError, match=r"^--distractors: billiards counts its discs"):
        task_factory("billiards", TaskOptions(distractors=2))


def test_a_class_without_an_expert_is_explored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = "from contactgraph.envs import PickupTask\n\n\nclass Plain(PickupTask):\n    pass\n"
    (tmp_path / "plain_task.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    task = known_task("plain_task:Plain")
    assert type(task.expert()).__name__ == "ExplorationPolicy"
    assert task.max_force is None
    sys.modules.pop("plain_task")


def test_lost_grasps_are_of_suction() -> None:
    with pytest.raises(InvalidInputError, match=r"^--lose-grasp: only suction loses its grasp, f"):
        task_factory("release", TaskOptions(lose_grasp=0.5))
    options = TaskOptions(lose_grasp=0.5)
    assert options.metadata["lose_grasp"] == 0.5
    task_factory("suction", options)


def test_distractors_in_the_way_are_of_pickup() -> None:
    options = TaskOptions(distractors=4, in_the_way=True)
    assert options.metadata["in_the_way"] is True
    task = task_factory("pickup", options)()
    task.reset(seed=3)
    assert task.scene.metadata["in_the_way"] is True
    with pytest.raises(InvalidInputError, match=r"^--in-the-way: only pickup has such scenes, f"):
        task_factory("door", options)


def test_the_hidden_switch_is_of_suction(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"^--hidden-switch: only suction has a switch, f"):
        task_factory("release", TaskOptions(hidden_switch=True))
    path = tmp_path / "hidden.h5"
    options = ["--episodes", "2", "--exploration", "0.5", "--hidden-switch", "--out", str(path)]
    assert cli.run(["collect", "suction", *options]) == 0
    dataset = read_trajectories(path)
    assert dataset.metadata["hidden_switch"] is True
    assert [each.control.shape[1] for each in dataset] == [2, 2]
    assert [each.holding is not None for each in dataset] == [True, True]
    policies = [each.scene.metadata["policy"] for each in dataset]
    assert policies == ["SuctionExpert", "HandlingPolicy"]


@pytest.mark.parametrize("name", ["suction", "release", "delay"])
def test_tasks_with_one_object_refuse_more(name: str) -> None:
    with pytest.raises(InvalidInputError, match=f"^--objects: {name} has 1 object, found 2"):
        task_factory(name, TaskOptions(objects=2))
    with pytest.raises(InvalidInputError, match=f"^--grasp: {name} has no fingers"):
        task_factory(name, TaskOptions(grasp="weld"))


def test_radius_is_pickup_s() -> None:
    with pytest.raises(InvalidInputError, match=r"^--radius: only pickup has bodies"):
        task_factory("door", TaskOptions(radius=0.05))
