"""Tasks by name: the library's, those of other packages, and classes named module:Class."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.cli.known_tasks import TASKS
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
    assert task_names() == (*TASKS, "franka") and task_names()[0] == "pickup"


def test_a_task_of_another_package_comes_by_its_entry_point() -> None:
    franka = known_task("franka")
    assert (franka.horizon, franka.max_force, len(franka.conditions)) == (50, 20.0, 2)


@pytest.mark.parametrize("name", TASKS)
def test_shipped_tasks_declare_their_largest_force(name: str) -> None:
    try:
        box = task_factory(name, {})().action_space
    except InvalidInputError as error:
        pytest.skip(str(error))  # its package is missing
    # Only a bound that is the same for all components and both directions is one number.
    alike = (box.high == box.high[:1]).all() and (box.low == -box.high).all()
    assert TASKS[name].max_force == (box.high[0] if alike and box.high.size else None)


def test_collect_and_control_take_a_class(
    in_examples: None, tmp_path: Path, interrupted: Callable
) -> None:
    path = tmp_path / "line.h5"
    options = ["--episodes", "3", "--distractors", "1", "--mixed", "--exploration", "0.34"]
    assert cli.run(["collect", LINE, *options, "--out", str(path)]) == 0
    dataset = read_trajectories(path)
    assert dataset.metadata == {"task": LINE, "seed": 0, "distractors": 1, "mixed": True}
    assert [each.scene.node_count for each in dataset] == [2, 3, 2]
    policies = [each.scene.metadata["policy"] for each in dataset]
    assert policies == ["PickupExpert", "PickupExpert", "ExplorationPolicy"]
    calls = interrupted("contactgraph.policies.task_policy")
    assert cli.run(["control", "pickup", LINE, "--distractors", "1"]) == 130
    (call,) = calls
    assert type(call.arguments[1]).__name__ == "Line" and call.options["horizon"] == 20


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (LINE, {"objects": 2}, "--objects: extend_task:Line has no such option; it has --distrac"),
        (LINE, {"fixed_seed": 3}, "--goal fixed: extend_task:Line has no such option; it has "),
        ("door", {"passive": True}, "--passive: door has no such option; it has --distractors, "),
        ("door", {"in_the_way": True}, "--in-the-way: door has no such option; it has --distr"),
        ("billiards", {"distractors": 2}, "--distractors: billiards has no such option; it has "),
        ("release", {"hidden_switch": True}, "--hidden-switch: release has no such option; it "),
        ("toss", {"engine": "pymunk"}, "--engine: toss has no such option; it has none"),
        ("franka", {"objects": 2}, "--objects: franka has no such option; it has --distractors, "),
    ],
)
def test_options_that_a_task_does_not_take(
    in_examples: None, name: str, options: dict, message: str
) -> None:
    with pytest.raises(InvalidInputError, match=f"^{message}"):
        task_factory(name, options)


def test_collect_without_a_cue(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "passive.h5"
    command = ["collect", "billiards", "--passive", "--objects", "4", "--out", str(path)]
    assert cli.run([*command, "--episodes", "2"]) == 0
    assert "expert" not in capsys.readouterr().out
    dataset = read_trajectories(path)
    assert dataset.metadata["passive"] is True
    for each in dataset:
        assert each.control.shape == (80, 0) and each.scene.metadata["policy"] == "RestPolicy"
        assert each.scene.static.any() and len(each.scene.planes)


def test_what_always_moves_by_itself_needs_no_option(tmp_path: Path) -> None:
    command = ["collect", "stack", "--episodes", "2", "--out"]
    assert cli.run([*command, str(tmp_path / "one.h5"), "--passive"]) == 0
    assert cli.run([*command, str(tmp_path / "other.h5")]) == 0
    one, other = (read_trajectories(tmp_path / name) for name in ("one.h5", "other.h5"))
    for each, same in zip(one, other, strict=True):
        assert each.control.shape == (100, 0) and np.isfinite(each.orientation).all()
        assert each.scene.polygons and np.isfinite(each.angular_velocity).all()
        assert (each.position == same.position).all()
    first, second = one
    assert (first.position[0] != second.position[0]).any()


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


OWN = """
from dataclasses import replace

from contactgraph.envs import PickupTask, RestPolicy


class Servo(PickupTask):
    explorer = RestPolicy
    exploration = 0.25

    @property
    def scene(self):
        return replace(super().scene, control_kind=("displacement", "displacement"))


class Long(Servo):
    horizon = 45
"""


def test_a_class_has_the_defaults_of_a_shipped_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its attributes are those of `KnownTask`; how to plan follows from what is controlled."""
    (tmp_path / "own_task.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    servo, long = known_task("own_task:Servo"), known_task("own_task:Long")
    assert type(servo.explorer()).__name__ == "RestPolicy" and servo.exploration == 0.25
    task = servo.make()
    task.reset(seed=0)
    shipped = TASKS["fetch-push"].horizon, TASKS["fetch-push"].starts
    assert servo.planning(task.scene) == (*shipped, "the control is a displacement")
    assert long.planning(task.scene)[:2] == (45, 64)
    force = TASKS["pickup"].make()
    force.reset(seed=0)
    assert TASKS["pickup"].planning(force.scene) == (20, 0, "the control is a force")
    sys.modules.pop("own_task")


def test_control_and_play_take_a_planner(
    monkeypatch: pytest.MonkeyPatch, interrupted: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(EXAMPLES)
    named = ["--planner", "extend_planner_mppi:MPPI"]
    calls = interrupted("contactgraph.policies.task_policy")
    assert cli.run(["control", "pickup", "pusht", *named]) == 130
    (call,) = calls
    assert call.options["planner"].__name__ == "MPPI" and call.options["starts"] == 0
    begun = interrupted("contactgraph.play.Session")
    assert cli.run(["play", "pickup", *named]) == 130
    assert begun[0].arguments[1].keywords["planner"].__name__ == "MPPI"
    capsys.readouterr()
    for more, said in (
        (["--starts", "8"], "--planner: it plans alone, so --starts, --routes and --segment must"),
        (["--planner", "extend_planner_mppi:PPI"], "--planner extend_planner_mppi:PPI: module"),
    ):
        assert cli.run(["control", "pickup", "pickup", *named, *more]) == 2
        assert capsys.readouterr().err.startswith(f"contactgraph: {said}")
    sys.modules.pop("extend_planner_mppi")


def test_distractors_in_the_way() -> None:
    task = task_factory("pickup", {"distractors": 4, "in_the_way": True})()
    task.reset(seed=3)
    assert task.scene.metadata["in_the_way"] is True


def test_the_options_of_suction_are_recorded(tmp_path: Path) -> None:
    hidden = tmp_path / "hidden.h5"
    options = ["--episodes", "2", "--hidden-switch", "--out", str(hidden)]
    assert cli.run(["collect", "suction", *options]) == 0
    dataset = read_trajectories(hidden)
    assert dataset.metadata["hidden_switch"] is True
    assert [each.control.shape[1] for each in dataset] == [2, 2]
    assert [each.holding is not None for each in dataset] == [True, True]
    policies = [each.scene.metadata["policy"] for each in dataset]
    assert policies == ["SuctionExpert", "HandlingPolicy"], "half of them explore by default"


@pytest.mark.parametrize(
    ("options", "explored"),
    [(["--exploration", "0"], 0), (["--expert", "demo"], 0), (["--resting", "0.75"], 1), ([], 2)],
)
def test_half_of_the_episodes_with_a_hidden_hold_explore(
    options: list[str], explored: int, tmp_path: Path
) -> None:
    out = tmp_path / "delay.h5"
    assert cli.run(["collect", "delay", "--episodes", "4", *options, "--out", str(out)]) == 0
    policies = [each.scene.metadata["policy"] for each in read_trajectories(out)]
    assert policies.count("HandlingPolicy") == explored
