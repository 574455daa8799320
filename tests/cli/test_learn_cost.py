"""Cost learning from the command line: output, files and rejected input."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.cli.known_tasks import TASKS
from contactgraph.cli.models import stored_model
from contactgraph.cli.tasks import task_factory
from contactgraph.control import (
    LearnedContact,
    LearnedCost,
    describe_cost,
    read_cost,
    write_cost,
)
from contactgraph.data import InvalidInputError, Scene, Trajectory, write_trajectories
from contactgraph.envs import PickupExpert, PickupTask, RestPolicy
from contactgraph.evaluate import collect
from contactgraph.model import AbsoluteFeatures, InvariantFeatures

STEPS = 45
"""Of a run: beyond the touch, which comes after 16 to 25."""
METADATA = {"task": "pickup", "seed": 0}


def cut(trajectory: Trajectory, steps: int = STEPS) -> Trajectory:
    assert trajectory.contact is not None
    states = {
        name: getattr(trajectory, name)[: steps + 1] for name in ("position", "velocity", "contact")
    }
    return replace(trajectory, **states, control=trajectory.control[:steps])


@pytest.fixture(scope="module")
def trajectories() -> list[Trajectory]:
    """Three demonstrations of one goal, with distractors."""
    factory = partial(PickupTask, 2, fixed_seed=7)
    return [cut(trajectory) for trajectory in collect([factory], [PickupExpert(noise=0.0)], 3, 0)]


@pytest.fixture(scope="module")
def demos(trajectories: list[Trajectory], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("demos") / "demos.h5"
    write_trajectories(path, trajectories, METADATA)
    return path


def learned(demos: Path, *options: object) -> list[str]:
    return ["learn-cost", "pickup", str(demos), "--steps", "20", *(str(each) for each in options)]


@pytest.fixture(scope="module")
def cost(demos: Path, made_up_cost: Callable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cost") / "cost.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("contactgraph.control.learn_cost", made_up_cost)
        assert cli.run(learned(demos, "--out", path)) == 0
    return path


@pytest.mark.slow
def test_a_cost_is_learned_and_planned_with(demos: Path, tmp_path: Path) -> None:
    paths = [tmp_path / "first.json", tmp_path / "again.json"]
    for path in paths:
        assert cli.run(learned(demos, "--out", path)) == 0
    first, again = map(read_cost, paths)
    assert np.array_equal(first.Q, again.Q) and np.array_equal(first.R, again.R), "one seed"
    assert first.history.imitation[-1] < first.history.imitation[0]
    assert [each.name for each in first.task_nodes if each.kept] == ["gripper", "target"]
    result = tmp_path / "out.json"
    command = ["control", "pickup", "pickup", "--episodes", "1", "--replan-every", "10"]
    assert cli.run([*command, "--cost", str(paths[0]), "--json", str(result)]) == 0
    values = json.loads(result.read_text())
    assert (values["cost"], values["episodes"]) == (str(paths[0]), 1)


def test_printed_and_written_output(
    demos: Path,
    made_up_cost: Callable,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("contactgraph.control.learn_cost", made_up_cost)
    out, picture = tmp_path / "cost.json", tmp_path / "cost.png"
    assert cli.run(learned(demos, "--out", out, "--picture", picture)) == 0
    said, progress = capsys.readouterr()
    lines = said.splitlines()
    assert [line.split(":")[0] for line in lines[:3]] == [
        "kept     gripper",
        "kept     target",
        "dropped  distractor-0, distractor-1",
    ]
    assert lines[0].startswith(
        "kept     gripper: actuated; in contact in 3 of 3 trajectories, from "
    )
    assert lines[2].endswith(": no active edge in any of 3 trajectories")
    assert lines[3].startswith("gripper - target  1 m costs as much as ")
    assert lines[4].startswith("target - goal     1 m costs as much as ")
    assert lines[5].startswith("imitation loss  ") and lines[5].endswith(" in the end")
    assert lines[6].startswith(f"{out}: learned from 3 demonstrations in ")
    assert lines[7:] == [f"{picture}: the cost as a picture"]
    assert progress.splitlines()[-1].startswith("learning: 20 of 20 imitation loss ")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in tmp_path.iterdir()} == {"cost.json", "cost.png"}


def test_the_file_records_how_it_was_made(
    demos: Path, cost: Path, trajectories: list[Trajectory]
) -> None:
    summary = describe_cost(cost)
    assert summary.cost.kept_nodes == ("gripper", "target")
    assert np.allclose(summary.cost.goal, trajectories[0].scene.goal)
    made = summary.made
    assert (made["model"], made["demonstrations"], made["runs"]) == ("pickup", str(demos), 3)
    assert (made["seed"], made["goal"], made["data"]) == (0, "the runs' own", METADATA)
    assert made["recipe"]["steps"] == 20 and made["recipe"]["horizon"] == 20
    assert made["seconds"] >= 0 and "jax" in made["versions"]
    assert len(made["model_sha256"]) == len(made["demonstrations_sha256"]) == 64


class Asked(Exception):
    """Raised instead of long work, with the given arguments."""


def asking(*arguments: object, **options: object) -> None:
    raise Asked(arguments, options)


def test_the_flags_are_passed_to_the_learner(
    demos: Path, trajectories: list[Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("contactgraph.control.learn_cost", asking)
    flags = ["--runs", 2, "--goal", "-0.1", "0.2", "--prior-weight", "0", "--horizon", 12]
    with pytest.raises(Asked) as asked:
        cli.run(learned(demos, "--out", tmp_path / "a.json", "--seed", 5, *flags))
    (_, dataset, recipe), options = asked.value.args
    assert (len(dataset), dataset.metadata) == (2, METADATA)
    assert (recipe.steps, recipe.horizon, recipe.prior_weight) == (20, 12, 0.0)
    assert (options["goal"], options["seed"]) == ((-0.1, 0.2), 5)
    assert options["limits"].upper.tolist() == [10.0, 10.0]  # The task's own.


@pytest.mark.parametrize(("task", "horizon"), [("pickup", 20), ("franka", 50), ("juggling", 20)])
def test_the_horizon_is_the_task_s(
    trajectories: list[Trajectory],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    task: str,
    horizon: int,
) -> None:
    monkeypatch.setattr("contactgraph.control.learn_cost", asking)
    demos = tmp_path / "demos.h5"
    write_trajectories(demos, trajectories, {"task": task})
    with pytest.raises(Asked) as asked:
        cli.run(learned(demos, "--out", tmp_path / "a.json"))
    assert asked.value.args[0][2].horizon == horizon


@pytest.mark.parametrize(
    ("task", "flags", "bound"),
    [
        ("pickup", [], 10.0),
        ("franka", [], 20.0),
        ("juggling", [], None),
        ("juggling", ["--max-force", "3.5"], 3.5),
        ("pickup", ["--max-force", "3.5"], 3.5),
    ],
)
def test_the_largest_force_is_the_task_s_or_the_flag_s(
    trajectories: list[Trajectory],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    task: str,
    flags: list[str],
    bound: float | None,
) -> None:
    monkeypatch.setattr("contactgraph.control.learn_cost", asking)
    demos = tmp_path / "demos.h5"
    write_trajectories(demos, trajectories, {"task": task})
    with pytest.raises(Asked) as asked:
        cli.run(learned(demos, "--out", tmp_path / "a.json", *flags))
    limits = asked.value.args[1]["limits"]
    if bound is None:
        assert limits is None
    else:
        assert limits.upper.tolist() == [bound] * 2 and limits.lower.tolist() == [-bound] * 2


@pytest.mark.parametrize("name", TASKS)
def test_shipped_tasks_declare_their_largest_force(name: str) -> None:
    try:
        box = task_factory(name, {})().action_space
    except InvalidInputError as error:
        pytest.skip(str(error))  # its package is missing
    # Only a bound that is the same for all components and both directions is one number.
    alike = (box.high == box.high[:1]).all() and (box.low == -box.high).all()
    assert TASKS[name].max_force == (box.high[0] if alike and box.high.size else None)


@pytest.mark.parametrize(
    ("features", "task", "options", "starts"),
    [
        (InvariantFeatures(), "pusht", (), 64),
        (InvariantFeatures(), "pusht", ("--starts", "16"), 16),
        (InvariantFeatures(), "pickup", (), 0),
        (AbsoluteFeatures(), "pusht", (), 0),
    ],
)
def test_control_searches_where_bodies_are_pushed_and_the_model_allows_it(
    features: InvariantFeatures | AbsoluteFeatures,
    task: str,
    options: tuple[str, ...],
    starts: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shipped = stored_model("pickup")
    model = replace(shipped, features=features)
    monkeypatch.setattr("contactgraph.cli.models.stored_model", lambda name: model)
    monkeypatch.setattr("contactgraph.evaluate.control_task", asking)
    with pytest.raises(Asked) as asked:
        cli.run(["control", "pickup", task, *options])
    assert asked.value.args[1]["starts"] == starts


def test_control_plans_with_it(
    cost: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    command = ["control", "pickup", "pickup"]
    monkeypatch.setattr("contactgraph.evaluate.control_task", asking)
    with pytest.raises(Asked) as asked:
        cli.run([*command, "--cost", str(cost)])
    planned = asked.value.args[1]["cost"]
    assert asked.value.args[1]["horizon"] == 40, "twice as far as with the task's own"
    assert isinstance(planned, LearnedCost) and np.array_equal(planned.Q, read_cost(cost).Q)
    demanding = tmp_path / "touch.json"
    contact = LearnedContact("touch", ("gripper", "target"), 2.0)
    write_cost(demanding, replace(read_cost(cost), contacts=(contact,)))
    with pytest.raises(Asked) as asked:
        cli.run([*command, "--cost", str(demanding)])
    assert asked.value.args[1]["horizon"] == 20, "the contact is demanded"
    cli.run(["info", str(demanding)])
    assert "touch gripper - target  each step without costs as much as 1.41 N" in (
        capsys.readouterr().out
    )
    with pytest.raises(Asked) as asked:
        cli.run(command)
    assert asked.value.args[1]["cost"] is None and asked.value.args[1]["horizon"] == 20


def test_info(cost: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["info", str(cost)]) == 0
    said, errors = capsys.readouterr()
    assert errors == ""
    assert said.startswith(f"{cost}: learned cost about gripper, target\n")
    for words in (
        "2 a node, control 2",
        "kept     gripper: actuated",
        "dropped  distractor-0, distractor-1: no",
    ):
        assert words in said
    for words in ("gripper - target  1 m costs", "imitation loss", "seed   ", '"steps": 20'):
        assert words in said


@pytest.fixture
def mistake(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    """Runs a command in an empty folder, expects a user error, and returns its message."""
    monkeypatch.chdir(tmp_path)

    def fails(*arguments: object) -> str:
        before = sorted(path.name for path in tmp_path.iterdir())
        assert cli.run([str(each) for each in arguments]) == 2
        said, errors = capsys.readouterr()
        assert said == ""
        assert sorted(path.name for path in tmp_path.iterdir()) == before, "something is left"
        (line,) = errors.splitlines()
        return line.removeprefix("contactgraph: ")

    return fails


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("", "learn-cost needs --out (see contactgraph learn-cost --help)"),
        ("--out cost", "--out must name a file that ends in .json, found cost"),
        ("--out no/cost.json", "no/cost.json: folder no does not exist"),
        ("--out a.json --picture a.svg", "--picture must name a file that ends in .png, found a.s"),
        ("--out a.json --picture no/a.png", "no/a.png: folder no does not exist"),
        ("--out a.json --runs 4", "--runs must be 1 to 3, the trajectories in "),
        ("--out a.json --runs 0", "--runs must be 1 to 3, the trajectories in "),
        ("--out a.json --max-force 0", "--max-force must be positive, found 0.0"),
        ("--out a.json --horizon 0", "--horizon must be 1 to 1000, found 0"),
        ("--out a.json --steps 0", "--steps must be 1 to 1000000, found 0"),
        ("--out a.json --seed -1", "--seed must be 0 to 4294967295, found -1"),
        ("--out a.json --prior-weight -1", "--prior-weight must be a number of at least 0, found"),
        ("--out a.json --prior-weight inf", "--prior-weight must be a number of at least 0, foun"),
        ("--out a.json --goal 0.1", "--goal must be 2 finite numbers [m], found 0.1"),
        ("--out a.json --goal 0.1 nan", "--goal must be 2 finite numbers [m], found 0.1 nan"),
        ("--out a.json --goal 0.1 x", "--goal must be numbers, found '0.1', 'x' (see"),
        ("--out a.json --goal", "--goal must be 2 finite numbers [m], found none"),
    ],
)
def test_mistakes_in_the_flags(mistake, demos: Path, flags: str, said: str) -> None:
    assert mistake("learn-cost", "pickup", demos, *flags.split()).startswith(said)


def with_scene(trajectory: Trajectory, **changes: object) -> Trajectory:
    return replace(trajectory, scene=replace(trajectory.scene, **changes))


def in_space(trajectory: Trajectory) -> Trajectory:
    state = np.zeros((STEPS + 1, 2, 3))
    scene = Scene(("a", "b"), ("x", "x"), np.array([True, False]), trajectory.scene.dt, 3)
    return Trajectory(scene, state, state, trajectory.control)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda trajectory: replace(trajectory, control=trajectory.control[:, :0]),
            "demos.h5: demonstration 0: control must have at least one axis, found none",
        ),
        (
            in_space,
            "demos.h5: the model is for dimension D 2, but demonstration 0 has 3; they must agree",
        ),
        (
            lambda trajectory: with_scene(trajectory, dt=0.02),
            "demos.h5: the model is for dt 0.05 s, but demonstration 0 has 0.02 s; they must agree",
        ),
        pytest.param(
            lambda trajectory: with_scene(trajectory, goal=None),
            "demos.h5: demonstration 0: goal is missing",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda trajectory: cut(trajectory, 19),
            "demos.h5: demonstration 0: control must have at least the horizon's 20 steps, "
            "found 19",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_trajectories_that_no_cost_can_be_learned_from(
    mistake,
    trajectories: list[Trajectory],
    tmp_path: Path,
    change: Callable[[Trajectory], Trajectory],
    said: str,
) -> None:
    write_trajectories(
        tmp_path / "demos.h5", [change(trajectory) for trajectory in trajectories], METADATA
    )
    assert mistake(*learned(Path("demos.h5"), "--out", "a.json")) == said


@pytest.mark.slow
def test_trajectories_without_contact(
    mistake, trajectories: list[Trajectory], tmp_path: Path
) -> None:
    rest = [cut(trajectory) for trajectory in collect([PickupTask], [RestPolicy()], 1, 0)]
    write_trajectories(tmp_path / "demos.h5", [*trajectories, *rest], METADATA)
    said = mistake(*learned(Path("demos.h5"), "--out", "a.json"))
    assert said.startswith("demos.h5: demonstration 3: the model infers no contact; at least one")


def test_files_that_are_no_good(mistake, demos: Path, tmp_path: Path) -> None:
    said = mistake(*learned(Path("none.h5"), "--out", "a.json"))
    assert said == "none.h5: does not exist"
    (tmp_path / "nan.h5").write_bytes(demos.read_bytes())
    with h5py.File(tmp_path / "nan.h5", "r+") as file:
        file["trajectories/000002/velocity"][7, 1, 0] = np.nan
    said = mistake(*learned(Path("nan.h5"), "--out", "a.json"))
    assert said.startswith("nan.h5: trajectories/000002: velocity"), said
    assert mistake("info", demos.parent / "nothing.json").endswith(
        "ship are door, franka, multi-pickup, pickup"
    )


def test_costs_that_do_not_fit(
    mistake, cost: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("contactgraph.control.ActiveSetMPC.reset", asking)  # which compiles
    said = mistake("control", "door", "door", "--cost", cost)
    assert said == (
        "the cost is about the nodes gripper, target, but the scene has no target; its nodes are "
        "gripper, door"
    )
    said = mistake("control", "pickup", "pickup", "--cost", "none.json")
    assert said == "none.json: does not exist"
    (tmp_path / "other.json").write_text(json.dumps({"success_rate": 1.0}))
    for command in (
        ["info", "other.json"],
        ["control", "pickup", "pickup", "--cost", "other.json"],
    ):
        said = mistake(*command)
        assert said == "other.json: must be a cost file, whose 'format' is 'contactgraph-cost'"
    content = json.loads(cost.read_text())
    content["R"][0][0] = -1.0
    (tmp_path / "bad.json").write_text(json.dumps(content))
    said = mistake("control", "pickup", "pickup", "--cost", "bad.json")
    assert said.startswith("bad.json: field 'R' must be positive definite, but its smallest eigenv")
