"""Cost learning from the command line: output, files and rejected input."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from contactgraph.cli import main as cli
from contactgraph.cli.models import stored_model
from contactgraph.control import (
    LearnedContact,
    LearnedCost,
    describe_cost,
    read_cost,
    write_cost,
)
from contactgraph.data import Trajectory, write_trajectories
from contactgraph.envs import PickupExpert, PickupTask
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
    assert first.imitation_loss[-1] < first.imitation_loss[0]
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
    out = tmp_path / "cost.json"
    assert cli.run(learned(demos, "--out", out)) == 0
    said, progress = capsys.readouterr()
    assert progress.splitlines()[-1].startswith("learning: 20 of 20 imitation loss ")
    assert {path.name for path in tmp_path.iterdir()} == {"cost.json"}
    assert cli.run(["info", str(out)]) == 0
    described = capsys.readouterr().out
    assert described.startswith(f"{out}: learned cost about gripper, target\n")
    for words in (
        "kept     gripper: actuated; in contact in 3 of 3 trajectories, from ",
        "kept     target: ",
        "dropped  distractor-0, distractor-1: no active edge in any of 3 trajectories",
        "gripper - target  1 m costs as much as ",
        "target - goal     1 m costs as much as ",
        "imitation loss  ",
    ):
        assert words in said and words in described
    assert f"{out}: learned from 3 demonstrations in " in said
    assert "2 a node, control 2" in described and '"steps": 20' in described


def test_the_file_records_how_it_was_made(
    demos: Path, cost: Path, trajectories: list[Trajectory]
) -> None:
    learned, made = describe_cost(cost)
    assert learned.kept_nodes == ("gripper", "target")
    assert np.allclose(learned.goal, trajectories[0].scene.goal)
    assert (made["model"], made["demonstrations"], made["runs"]) == ("pickup", str(demos), 3)
    assert (made["seed"], made["goal"], made["data"]) == (0, "the runs' own", METADATA)
    assert made["recipe"]["steps"] == 20 and made["recipe"]["horizon"] == 20
    assert made["seconds"] >= 0 and "jax" in made["versions"]
    assert len(made["model_sha256"]) == len(made["demonstrations_sha256"]) == 64


LEARN = "contactgraph.control.learn_cost"


def test_the_flags_are_passed_to_the_learner(
    demos: Path, tmp_path: Path, interrupted: Callable
) -> None:
    calls = interrupted(LEARN)
    flags = ["--runs", 2, "--goal", "-0.1", "0.2", "--prior-weight", "0", "--horizon", 12]
    assert cli.run(learned(demos, "--out", tmp_path / "a.json", "--seed", 5, *flags)) == 130
    (_, dataset, recipe), options = calls[0].arguments, calls[0].options
    assert (len(dataset), dataset.metadata) == (2, METADATA)
    assert (recipe.steps, recipe.horizon, recipe.prior_weight) == (20, 12, 0.0)
    assert (options["goal"], options["seed"]) == ((-0.1, 0.2), 5)


@pytest.mark.parametrize(
    ("task", "flags", "horizon", "bound"),
    [
        ("pickup", [], 20, 10.0),
        ("franka", [], 50, 20.0),
        ("juggling", [], 20, None),
        ("juggling", ["--max-force", "3.5"], 20, 3.5),
        ("pickup", ["--max-force", "3.5"], 20, 3.5),
    ],
)
def test_the_horizon_and_the_largest_force_are_the_task_s_unless_given(
    trajectories: list[Trajectory],
    tmp_path: Path,
    interrupted: Callable,
    task: str,
    flags: list[str],
    horizon: int,
    bound: float | None,
) -> None:
    calls = interrupted(LEARN)
    demos = tmp_path / "demos.h5"
    write_trajectories(demos, trajectories, {"task": task})
    assert cli.run(learned(demos, "--out", tmp_path / "a.json", *flags)) == 130
    assert calls[0].arguments[2].horizon == horizon
    limits = calls[0].options["limits"]
    if bound is None:
        assert limits is None
    else:
        assert limits.upper.tolist() == [bound] * 2 and limits.lower.tolist() == [-bound] * 2


@pytest.mark.parametrize(
    ("features", "task", "options", "starts"),
    [
        (InvariantFeatures(), "pusht", (), 32),
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
    interrupted: Callable,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = replace(stored_model("pickup"), features=features)
    monkeypatch.setattr("contactgraph.cli.models.stored_model", lambda name: model)
    calls = interrupted("contactgraph.policies.task_policy")
    assert cli.run(["control", "pickup", task, *options]) == 130
    assert calls[0].arguments[2].starts == starts


def test_control_plans_with_it(
    cost: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    interrupted: Callable,
) -> None:
    """Twice as far as with the task's own cost, unless it demands a contact."""
    demanding = tmp_path / "touch.json"
    contact = LearnedContact("touch", ("gripper", "target"), 2.0)
    write_cost(demanding, replace(read_cost(cost), contacts=(contact,)))
    calls = interrupted("contactgraph.policies.task_policy")
    for options in (["--cost", str(cost)], ["--cost", str(demanding)], []):
        assert cli.run(["control", "pickup", "pickup", *options]) == 130
    assert [call.arguments[2].horizon for call in calls] == [40, 20, 20]
    planned, demands, own = (call.options["cost"] for call in calls)
    assert isinstance(planned, LearnedCost) and np.array_equal(planned.Q, read_cost(cost).Q)
    assert len(demands.contacts) == 1 and own is None
    cli.run(["info", str(demanding)])
    assert "touch gripper - target  each step without costs as much as 1.41 N" in (
        capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--out a.json --runs 4", "--runs must be 1 to 3, the trajectories in "),
        ("--out cost", "--out must name a file that ends in .json, found cost"),
        ("--out a.json --runs 0", "--runs must be 1 to 3, the trajectories in "),
        ("--out a.json --max-force 0", "--max-force must be positive, found 0.0"),
        ("--out a.json --horizon 0", "--horizon must be 1 to 1000, found 0"),
        ("--out a.json --steps 0", "--steps must be 1 to 1000000, found 0"),
        ("--out a.json --seed -1", "--seed must be 0 to 4294967295, found -1"),
        ("--out a.json --prior-weight inf", "--prior-weight must be a number of at least 0, foun"),
        ("--out a.json --goal 0.1", "--goal must be 2 finite numbers [m], found 0.1"),
        ("--out a.json --goal 0.1 nan", "--goal must be 2 finite numbers [m], found 0.1 nan"),
        ("--out a.json --goal 0.1 x", "learn-cost: --goal must be numbers, found '0.1', 'x' (see"),
        ("--out a.json --goal", "--goal must be 2 finite numbers [m], found none"),
    ],
)
def test_mistakes_in_the_flags(mistake: Callable, demos: Path, flags: str, said: str) -> None:
    assert mistake("learn-cost", "pickup", demos, *flags.split()).startswith(said)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda trajectory: replace(trajectory, control=trajectory.control[:, :0]),
            "demos.h5: demonstration 0: control must have at least one axis, found none",
        ),
        (
            lambda trajectory: replace(trajectory, scene=replace(trajectory.scene, dt=0.02)),
            "demos.h5: the model is for dt 0.05 s, but demonstration 0 has 0.02 s; they must agree",
        ),
    ],
)
def test_trajectories_that_no_cost_can_be_learned_from(
    mistake: Callable,
    trajectories: list[Trajectory],
    tmp_path: Path,
    change: Callable[[Trajectory], Trajectory],
    said: str,
) -> None:
    write_trajectories(tmp_path / "demos.h5", map(change, trajectories), METADATA)
    assert mistake(*learned(Path("demos.h5"), "--out", "a.json")) == said


def test_costs_that_do_not_fit(
    mistake: Callable, cost: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("contactgraph.control.ActiveSetMPC.reset", lambda *given: pytest.fail())
    said = mistake("control", "door", "door", "--cost", cost)
    assert said == (
        "the cost is about the nodes gripper, target, but the scene has no target; its nodes are "
        "gripper, door"
    )
    content = json.loads(cost.read_text())
    content["R"][0][0] = -1.0
    (tmp_path / "bad.json").write_text(json.dumps(content))
    (tmp_path / "other.json").write_text(json.dumps({"success_rate": 1.0}))
    for name, said in (
        ("none.json", "does not exist"),
        ("bad.json", "field 'R' must be positive definite, but its smallest eigenv"),
        ("other.json", "must be a cost file, whose 'format' is 'contactgraph-cost'"),
    ):
        assert mistake("control", "pickup", "pickup", "--cost", name).startswith(f"{name}: {said}")
    assert mistake("info", "other.json").startswith("other.json: must be a cost file")
