"""A run folder and a learned cost by the commands themselves, without the compilation of learning.

The results of `fit` and `learn_cost` are made up here; `tests/train` and `tests/control` test both.
Where a test is about what a command asks for, the work is interrupted before it begins.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from contactgraph.cli import main as cli


@pytest.fixture
def mistake(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    """Runs a command in an empty folder, expects a user error, and returns its message."""
    monkeypatch.chdir(tmp_path)

    def fails(*arguments: object) -> str:
        before = sorted(path.name for path in tmp_path.rglob("*"))
        assert cli.run([str(each) for each in arguments]) == 2
        said, errors = capsys.readouterr()
        assert sorted(path.name for path in tmp_path.rglob("*")) == before, "something is left"
        assert said == ""
        (line,) = errors.splitlines()
        assert line.startswith("contactgraph: ")
        return line.removeprefix("contactgraph: ")

    return fails


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], list[SimpleNamespace]]:
    """Replaces a function by Ctrl-C; returns the list of its calls: `arguments` and `options`."""

    def replaced(name: str) -> list[SimpleNamespace]:
        calls = []

        def work(*arguments: object, **options: object) -> None:
            calls.append(SimpleNamespace(arguments=arguments, options=options))
            raise KeyboardInterrupt

        monkeypatch.setattr(name, work)
        return calls

    return replaced


@pytest.fixture(scope="session")
def trained(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a training of 12 steps with a check every 4. Read only."""
    import jax.numpy as jnp

    from contactgraph.train import FitProgress, FitResult, FitStatus, HeldOutBaselines

    baselines = HeldOutBaselines(
        constant_velocity_rmse_m=0.375, standing_still_rmse_m=0.5, moving=True
    )

    def fit(state, train, held_out, config, on_check, devices, near_pairs):
        for step, error in ((4, 0.5), (8, 0.25), (12, 0.125)):
            state = replace(state, step=jnp.asarray(step), best_error=jnp.asarray(error))
            terms = {"prediction": 2.0, "squared": 1.0, "rollout": step / 12 // 1, "prior": 0.5}
            on_check(FitProgress(step, config.steps, terms, error, 0.1 * step, state, baselines))
        return FitResult(state.best_model, error, FitStatus.finished, state, 1.25, baselines)

    path = tmp_path_factory.mktemp("trained") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("contactgraph.train.fit", fit)
        options = ["--model", "ours-recurrent", "--steps", "12"]
        assert cli.run(["train", str(recorded), "--out", str(path), *options]) == 0
    return path


@pytest.fixture(scope="session")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """2 pickups of another seed: all tests that evaluate share their compiled programs."""
    path = tmp_path_factory.mktemp("fresh") / "data.h5"
    arguments = ["collect", "pickup", "--episodes", "2", "--seed", "1", "--out", str(path)]
    assert cli.run(arguments) == 0
    return path


@pytest.fixture(scope="session")
def made_up_cost() -> Callable:
    """Stands in for `learn_cost`: the cost of a pickup among two distractors."""

    def learn(model, dataset, config, *, goal, limits, seed, on_step):
        import jax.numpy as jnp

        from contactgraph.control import LearnedCost
        from contactgraph.control.learned_cost import TaskNode

        runs = len(dataset)
        for step in range(1, config.steps + 1):
            on_step(step, 1.0 / step)
        losses = 1.0 / jnp.arange(1.0, config.steps + 1.0)
        return LearnedCost(
            Q=jnp.eye(8),
            R=jnp.eye(2),
            goal=jnp.asarray(dataset.trajectories[0].scene.goal if goal is None else goal),
            nodes=jnp.asarray([0, 1], jnp.int32),
            kept_nodes=("gripper", "target"),
            imitation_loss=losses,
            task_nodes=(
                TaskNode("gripper", True, runs, runs, 0.8),
                TaskNode("target", False, runs, runs, 0.8),
                TaskNode("distractor-0", False, runs, 0, None),
                TaskNode("distractor-1", False, runs, 0, None),
            ),
        )

    return learn
