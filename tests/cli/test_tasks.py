"""Tasks by name: the library's, those of other packages, and classes named module:Class."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.data import InvalidInputError, read_trajectories
from contactgraph.envs import ExplorationPolicy, PickupTask, RestPolicy, Task
from contactgraph.envs.registry import (
    SHIPPED,
    TaskSpec,
    make,
    task_factory,
    task_names,
    task_spec,
)
from contactgraph.evaluate.forced import recorded_task
from contactgraph.model import load_model, shipped_model
from contactgraph.policies import Planning, task_policy

EXAMPLES = Path(__file__).parents[2] / "examples"
LINE = "extend_task:Line"
MODEL = load_model(shipped_model("pickup")).model


@pytest.fixture
def in_examples(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The folder of the examples as the current one, whose modules can be named."""
    monkeypatch.chdir(EXAMPLES)
    yield
    sys.modules.pop("extend_task", None)


def test_names_are_listed_without_an_import(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.EntryPoint.load", lambda entry: pytest.fail("loaded"))
    assert task_names() == (*SHIPPED, "franka") and task_names()[0] == "pickup"


def test_a_task_of_another_package_comes_by_its_entry_point() -> None:
    franka = task_spec("franka")
    assert (franka.horizon, franka.max_force, len(franka.test_conditions())) == (50, 20.0, 2)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_class_has_the_name_that_it_is_listed_under(name: str) -> None:
    spec = task_spec(name)
    assert spec.make.name == name and spec.summary


def test_neither_jax_nor_a_simulator_is_imported_to_read_a_task() -> None:
    code = (
        "import sys\n"
        "from contactgraph.envs.registry import task_names, task_spec\n"
        "for name in task_names(): task_spec(name).summary, task_spec(name).options\n"
        "print({'jax', 'Box2D', 'pymunk', 'mujoco', 'gym_pusht'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_tasks_declare_their_largest_force(name: str) -> None:
    try:
        box = task_factory(name, {})().action_space
    except InvalidInputError as error:
        pytest.skip(str(error))  # its package is missing
    # Only a bound that is the same for all components and both directions is one number.
    alike = (box.high == box.high[:1]).all() and (box.low == -box.high).all()
    assert task_spec(name).max_force == (box.high[0] if alike and box.high.size else None)


def test_collect_and_control_take_a_class(
    in_examples: None, tmp_path: Path, interrupted: Callable
) -> None:
    path = tmp_path / "line.h5"
    options = ["--episodes", "3", "--distractors", "1", "--mixed", "--exploration", "0.34"]
    assert cli.run(["collect", LINE, *options, "--out", str(path)]) == 0
    dataset = read_trajectories(path)
    metadata = {"task": LINE, "seed": 0, "distractors": 1, "mixed": True}
    assert {**dataset.metadata, "simulator": ""} == {**metadata, "simulator": ""}
    assert [each.scene.node_count for each in dataset] == [2, 3, 2]
    policies = [each.scene.metadata["policy"] for each in dataset]
    assert policies == ["PickupExpert", "PickupExpert", "ExplorationPolicy"]
    calls = interrupted("contactgraph.policies.task_policy")
    assert cli.run(["control", "pickup", LINE, "--distractors", "1"]) == 130
    (call,) = calls
    assert type(call.arguments[1]).__name__ == "Line" and call.arguments[2].horizon == 20


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (LINE, {"objects": 2}, "objects: extend_task:Line has no such option; it has distractors"),
        (LINE, {"fixed_seed": 3}, "fixed_seed: extend_task:Line has no such option; it has "),
        ("door", {"passive": True}, "passive: door has no such option; it has distractors, "),
        ("door", {"in_the_way": True}, "in_the_way: door has no such option; it has distr"),
        ("billiards", {"distractors": 2}, "distractors: billiards has no such option; it has "),
        ("release", {"hidden_switch": True}, "hidden_switch: release has no such option; it "),
        ("toss", {"engine": "pymunk"}, "engine: toss has no such option; it has none"),
        ("franka", {"objects": 2}, "objects: franka has no such option; it has distractors, "),
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


def test_a_class_without_an_expert_is_explored_or_rests() -> None:
    class Plain:
        """A task; with more to say."""

    class Undriven:
        passive = True

    plain, undriven = TaskSpec.of(Plain), TaskSpec.of(Undriven)
    assert plain.expert is plain.demonstrator is plain.explorer is ExplorationPolicy
    assert undriven.expert is undriven.demonstrator is undriven.explorer is RestPolicy
    assert plain.max_force is None and (plain.summary, undriven.summary) == (
        "A task; with more to say",
        "",
    )


OWN = """
from dataclasses import replace

from contactgraph.envs import PickupTask, RestPolicy


class Servo(PickupTask):
    explorer = RestPolicy
    exploration = 0.25

    def __init__(self, gain: float = 1.0, label: str = "none", distractors: int = 0):
        super().__init__(distractors)
        self.gain = gain

    def hold_rule(self, seed):
        return super().hold_rule(seed)[0], {"seen_gain": self.gain}

    @property
    def scene(self):
        return replace(super().scene, control_kind=("displacement", "displacement"))


class Long(Servo):
    horizon = 45
    clearance = 0.02
"""


@pytest.fixture
def own_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The name of a user's class with options of its own."""
    (tmp_path / "own_task.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    yield "own_task:Servo"
    sys.modules.pop("own_task", None)


def begun(name: str, **options: int) -> Task:
    task = make(name, **options)
    task.reset(seed=0)
    return task


def test_a_class_has_the_defaults_of_a_shipped_task(own_task: str) -> None:
    """How to plan follows from what is controlled."""
    servo = task_spec(own_task)
    assert servo.explorer is RestPolicy and servo.exploration == 0.25

    def plans(name: str, **options: Any) -> tuple:
        found = Planning(**options).chosen(begun(name), MODEL)
        assert found.chosen(begun(name), MODEL) == found
        return found.horizon, found.starts, found.routes, found.clearance, found.reason

    assert plans(own_task) == (30, 32, 0, None, "the control is a displacement")
    # Routes, round what is not to be touched, replace the search.
    assert plans("own_task:Long") == (45, 0, 7, 0.02, "the control is a displacement")
    assert plans("pickup") == (20, 0, 0, None, "the control is a force")
    loaded = Planning().chosen(begun("multi-pickup", objects=5), MODEL)
    assert (loaded.horizon, loaded.leap, loaded.reason) == (35, True, "a force moves 6 bodies")
    assert Planning(leap=False).chosen(begun("multi-pickup", objects=5), MODEL).leap is False
    assert plans("billiards") == (60, 64, 0, None, "the task says so")
    assert plans("pickup", horizon=9, starts=8) == (9, 8, 0, None, "as asked for")


def test_a_class_plans_in_python_as_by_the_command(own_task: str) -> None:
    planner = task_policy(MODEL, begun(own_task)).mpc.config.planner
    (approaches,) = planner.proposals
    assert (planner.horizon, approaches.starts) == (30, 32)


def test_a_hidden_switch_changes_how_to_plan() -> None:
    for hidden, starts in ((False, 0), (True, 32)):
        task = make("suction", hidden_switch=hidden)
        task.reset(seed=0)
        plans = Planning().chosen(task, MODEL)
        assert (plans.horizon, plans.starts) == (20, starts)


def test_a_class_with_the_attributes_of_a_shipped_task_gets_the_same_entry() -> None:
    shipped = task_spec("unknown-mass")
    names = ("expert", "demonstrator", "explorer", "fixed_start", "horizon", "starts")
    given = {each: getattr(shipped.make, each) for each in (*names, "max_force", "conditions")}
    own = type("Own", (), {**given, "__doc__": "A pusher moves a block of unknown mass to a goal."})
    assert replace(TaskSpec.of(own), make=shipped.make) == shipped
    assert TaskSpec.of(own).summary == shipped.summary
    inherited = TaskSpec.of(type("Inherited", (PickupTask,), {}))
    pickup = task_spec("pickup")
    assert inherited.conditions == pickup.conditions and inherited.expert is pickup.expert
    assert inherited.demonstrator.keywords == {"noise": 0.0}


def test_any_option_of_a_class_comes_by_its_name(own_task: str, tmp_path: Path) -> None:
    path = tmp_path / "own.h5"
    pairs = ["--option", "gain=2.5", "--option", "label=two words", "--option", "distractors=1"]
    assert cli.run(["collect", own_task, "--episodes", "2", *pairs, "--out", str(path)]) == 0
    dataset = read_trajectories(path)
    options = {"gain": 2.5, "label": "two words", "distractors": 1}
    assert dataset.metadata.items() >= {**options, "task": own_task, "seed": 0}.items()
    assert [each.scene.metadata["seen_gain"] for each in dataset] == [2.5] * 2


def test_an_option_that_is_no_flag_makes_the_recorded_task_again(tmp_path: Path) -> None:
    path = tmp_path / "wide.h5"
    options = ["--option", "radius=0.05", "--option", "in_the_way=true", "--distractors", "2"]
    assert cli.run(["collect", "release", "--episodes", "1", *options, "--out", str(path)]) == 0
    dataset = read_trajectories(path)
    (trajectory,) = dataset
    task = recorded_task(dataset, trajectory)
    task.reset(seed=trajectory.scene.metadata["seed"])
    assert (task.scene.radius == 0.05).all() and task.scene.metadata["in_the_way"] is True
    assert (task.world.position == trajectory.position[0]).all()


def test_control_and_play_take_an_option(own_task: str, interrupted: Callable) -> None:
    calls = interrupted("contactgraph.policies.task_policy")
    assert cli.run(["control", "pickup", own_task, "--option", "gain=2"]) == 130
    assert cli.run(["control", "pickup", "own_task:Long"]) == 130
    assert calls[0].arguments[1].gain == 2
    first, second = (call.arguments[2] for call in calls)
    assert (first.clearance, first.starts) == (None, 32)
    assert (second.clearance, second.starts, second.routes) == (0.02, 0, 7)
    begun = interrupted("contactgraph.play.Session")
    assert cli.run(["play", "pickup", own_task, "--option", "gain=3"]) == 130
    assert begun[0].arguments[1].keywords["options"] == {own_task: {"gain": 3}}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("gani=2", "gani: own_task:Servo has no such option; it has gain, label, distractors"),
        ("gain", "--option must be KEY=VALUE, found 'gain'"),
        (
            "gain=0.0.4",
            "--option gain: must be a number, true, false or text that beg",
        ),
        ("gain=[1]", "--option gain: must be a number, true, false or text that beg"),
        ("gain=", "--option gain: must be a number, true, false or text that beg"),
        ("gain=big", "gain of own_task:Servo must be of type float, found 'big'"),
        ("gain=true", "gain of own_task:Servo must be of type float, found True"),
        ("distractors=1.5", "distractors of own_task:Servo must be of type int, found 1.5"),
        ("label=3", "label of own_task:Servo must be of type str, found 3"),
        ("gain=1 --option gain=2", "--option gain: it is given twice"),
        ("distractors=1 --distractors 2", "--option distractors: it is given twice"),
    ],
)
def test_an_option_that_cannot_be_used(
    own_task: str, mistake: Callable, options: str, said: str
) -> None:
    for command in (("collect", own_task, "--out", "a.h5"), ("control", "pickup", own_task)):
        assert mistake(*command, "--option", *options.split()).startswith(said)


def test_control_and_play_take_a_planner(
    monkeypatch: pytest.MonkeyPatch, interrupted: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(EXAMPLES)
    named = ["--planner", "extend_planner_mppi:MPPI"]
    calls = interrupted("contactgraph.policies.task_policy")
    assert cli.run(["control", "pickup", "pusht", *named]) == 130
    (call,) = calls
    plans = call.arguments[2]
    assert plans.planner.__name__ == "MPPI" and plans.starts == plans.routes == 0
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
