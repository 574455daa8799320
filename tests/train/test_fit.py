"""Trainings: inputs, dependence on the seed, end, resumption, and learning."""

import contextlib
import dataclasses
import importlib
import itertools
import json
import math
import shutil
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from training import (
    BASELINES,
    CONFIG,
    Enough,
    assert_bit_equal,
    bit_equal,
    first_state,
    split,
    states_until,
    trained_on,
)

from contactgraph.cli import main as cli
from contactgraph.data import (
    Dataset,
    InvalidInputError,
    pad_trajectories,
    read_trajectories,
    strip_contacts,
    write_trajectories,
)
from contactgraph.evaluate import evaluate_open_loop
from contactgraph.model import PRESETS, ModelConfig
from contactgraph.model.io import load_model
from contactgraph.train import (
    FitProgress,
    FitResult,
    FitStatus,
    LossTerms,
    RunFolder,
    TrainConfig,
    fit,
    initial_state,
    load_checkpoint,
    save_checkpoint,
)
from contactgraph.train.fit import objective_of, training_data
from contactgraph.train.objective import TrainingData, bounded_distance
from contactgraph.train.window_loss import WindowObjective

GOLDEN = Path(__file__).parents[1] / "golden" / "short_training.json"

FIT = importlib.import_module("contactgraph.train.fit")
"""The module; the package has the function of the same name."""
LOSS = importlib.import_module("contactgraph.train.window_loss")

pytestmark = pytest.mark.usefixtures("trained")  # it fills the compilation cache


@pytest.fixture(scope="module")
def straight(recorded: Path, trained: Path) -> tuple[FitResult, list[FitProgress]]:
    """The result of the training that nothing disturbs, and its three checks."""
    checks: list[FitProgress] = []
    result = trained_on(split(recorded), first_state(), checks.append)
    assert result.status is FitStatus.finished
    return result, checks


def test_contact_labels_are_not_read(recorded: Path, straight: tuple, tmp_path: Path) -> None:
    bare, (with_labels, _) = tmp_path / "bare.h5", straight
    dataset = read_trajectories(recorded)
    write_trajectories(bare, strip_contacts(dataset).trajectories, dataset.metadata)
    assert all(run.contact is None for run in read_trajectories(bare))
    without = trained_on(split(bare), first_state())
    assert_bit_equal(without.state, with_labels.state)
    assert without.held_out_rmse_m == with_labels.held_out_rmse_m


def test_masses_radii_and_names_are_not_read(recorded: Path, straight: tuple) -> None:
    train, held_out = split(recorded)
    nameless = [
        dataclasses.replace(
            run,
            scene=dataclasses.replace(
                run.scene,
                node_name=("hand", "cup"),
                node_type=("a", "b"),
                mass=None,
                radius=None,
                goal=None,
                metadata={},
            ),
        )
        for run in train
    ]
    found = states_until(4, first_state(), (Dataset(tuple(nameless)), held_out))
    assert_bit_equal(found, straight[1][0].state)


def test_one_seed_makes_one_result_and_another_seed_another(
    recorded: Path, straight: tuple
) -> None:
    parts, once = split(recorded), straight[1][0].state
    assert_bit_equal(states_until(4, first_state(), parts), once)
    # The same model, other draws: the key alone must make the difference.
    other = dataclasses.replace(first_state(), key=first_state(1).key)
    assert not bit_equal(states_until(4, other, parts).model, once.model)
    assert not bit_equal(first_state(1).model, first_state(0).model)


def test_a_first_state_has_the_types_of_all_that_follow(straight: tuple) -> None:
    """Else every stage would be compiled twice, and compiling is most of a short training."""

    def types(state: object) -> list:
        arrays = jax.tree.leaves(eqx.filter(state, eqx.is_array))
        return [(leaf.shape, leaf.dtype, leaf.weak_type) for leaf in arrays]

    assert types(straight[1][0].state) == types(first_state())


def test_another_number_of_trajectories_recompiles_nothing(recorded: Path) -> None:
    """Programs are compiled for the shapes of all arrays that they are given."""

    def shapes(count: int) -> list[tuple[int, ...]]:
        train, held_out = split(recorded)
        model, part = first_state().model, Dataset(train.trajectories[:count])
        data = training_data(model, objective_of(model), part, held_out, CONFIG, jax.devices()[:1])
        return [np.shape(leaf) for leaf in jax.tree.leaves(data)]

    assert shapes(5) == shapes(6)


def test_training_stops_where_the_held_out_error_no_longer_falls(recorded: Path) -> None:
    """Not before the loss holds rollouts, of which the error is."""
    hopeless = dataclasses.replace(
        first_state(),
        best_error=jnp.zeros((), float),
        checks_without_gain=jnp.full((), CONFIG.patience - 1, int),
    )
    checks = []
    early = states_until(4, hopeless, split(recorded))
    assert int(early.checks_without_gain) == 0
    hopeless = dataclasses.replace(hopeless, step=early.step)
    result = trained_on(split(recorded), hopeless, checks.append)
    assert result.status is FitStatus.stopped_early
    assert [check.step for check in checks] == [8]
    assert_bit_equal(result.model, hopeless.best_model)
    again = trained_on(split(recorded), result.state, checks.append)
    assert again.status is FitStatus.stopped_early
    assert len(checks) == 1, "resumed, it stays stopped"


def test_a_loss_that_is_not_finite_ends_training_and_is_not_saved(recorded: Path) -> None:
    broken = jax.tree.map(
        lambda leaf: leaf * jnp.nan if eqx.is_inexact_array(leaf) else leaf, first_state().model
    )
    state = dataclasses.replace(first_state(), model=broken)
    checks = []
    result = trained_on(split(recorded), state, checks.append)
    assert result.status is FitStatus.not_finite
    assert checks == [], "it is not offered to be saved"
    assert_bit_equal(result.model, state.best_model)
    assert math.isinf(result.held_out_rmse_m)


def test_the_best_model_is_kept(recorded: Path, straight: tuple) -> None:
    result, checks = straight
    best = min(checks, key=lambda check: check.held_out_rmse_m)
    assert result.held_out_rmse_m == best.held_out_rmse_m
    assert_bit_equal(result.model, best.state.model)
    # One check more, from another model with the memory of a better one.
    good = checks[1].state
    lost = dataclasses.replace(
        good, model=first_state(3).model, best_error=jnp.full((), 1e-6, float)
    )
    result = trained_on(split(recorded), lost)
    assert result.held_out_rmse_m == pytest.approx(1e-6)
    assert_bit_equal(result.model, good.best_model)


def test_the_command_trains_on_no_held_out_trajectory(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = []

    def spy(state: object, train: Dataset, held_out: Dataset, *arguments: object) -> None:
        parts.extend([train, held_out])
        raise KeyboardInterrupt

    monkeypatch.setattr("contactgraph.train.fit", spy)
    options = ["--out", str(tmp_path / "run"), "--model", "ours-recurrent"]
    assert cli.run(["train", str(recorded), *options]) == 130
    train, held_out = ({run.position.tobytes() for run in part} for part in parts)
    assert (len(train), len(held_out)) == (17, 3)
    assert not train & held_out


def test_training_draws_from_its_own_part_and_checks_on_the_other(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each part is padded once, without contact labels."""
    padded, given = [], []

    def spy(trajectories: Dataset, **options: bool | None) -> object:
        padded.append(trajectories)
        assert options == {"contacts": False, "turn_length": None, "steps": longest}
        return pad_trajectories(trajectories, **options)

    def stop(self: object, state: object, data: TrainingData, *rest: object) -> None:
        given.extend([data.source, data.held_out.windows])
        raise Enough

    monkeypatch.setattr(FIT, "pad_trajectories", spy)
    monkeypatch.setattr(WindowObjective, "advance", stop)
    train, held_out = split(recorded)
    longest = max(run.steps for run in (*train, *held_out))
    with contextlib.suppress(Enough):
        fit(first_state(), train, held_out, CONFIG)
    parts = [train.trajectories, held_out.trajectories]
    assert [each.trajectories for each in padded] == parts
    source, checked = given
    every = np.stack([run.position for run in train]).astype(np.float32)
    np.testing.assert_array_equal(source.trajectories.position[: len(train)], every)
    states = {state.astype(np.float32).tobytes() for run in held_out for state in run.position}
    assert all(np.asarray(state).tobytes() in states for state in checked.position[:, 0])


def test_a_step_follows_the_gradient_of_the_loss_plus_the_weighted_rollout(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Toy losses with known gradients, 1 and the parameter itself; Adam's first moment tells."""

    def total(model: object, power: int) -> jax.Array:
        leaves = jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array))
        return sum((jnp.sum(leaf**power) / power for leaf in leaves), jnp.zeros(()))

    monkeypatch.setattr(
        LOSS, "window_loss", lambda model, *rest: LossTerms.of(prediction=total(model, 1))
    )
    monkeypatch.setattr(LOSS, "rollout_loss", lambda model, *rest: total(model, 2))
    monkeypatch.setattr(FIT, "_rollout_rmse", lambda *rest: jnp.ones(()))
    config = TrainConfig(steps=1, check_every=1, rollout_from=0.0, bystanders=0)
    model = first_state().model
    state = fit(initial_state(model, config, 0), *split(recorded), config).state
    params = jax.tree.map(np.asarray, eqx.filter(model, eqx.is_inexact_array))
    gradient = jax.tree.map(lambda leaf: 1.0 + config.weights.rollout * leaf, params)
    norm = np.sqrt(sum(float(np.sum(leaf**2)) for leaf in jax.tree.leaves(gradient)))
    assert norm > 1.0, "the gradient is clipped to norm 1"
    clipped = jax.tree.map(lambda leaf: leaf / norm, gradient)
    moment = state.optimiser[1][0].mu
    for found, expected in zip(jax.tree.leaves(moment), jax.tree.leaves(clipped), strict=True):
        np.testing.assert_allclose(found, 0.1 * expected, rtol=1e-5)


def test_a_learned_contact_distance_stays_positive(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A loss that pulls it down would take it below zero within the 40 steps."""

    def pull(model: object, *rest: object) -> LossTerms:
        return LossTerms.of(prediction=model.features.contact_distance)

    monkeypatch.setattr(LOSS, "window_loss", pull)
    monkeypatch.setattr(FIT, "_rollout_rmse", lambda *rest: jnp.ones(()))
    config = TrainConfig(
        steps=40, check_every=20, rollout_from=1.0, bystanders=0, learning_rate=0.01
    )
    result = fit(initial_state(first_state().model, config, 0), *split(recorded), config)
    distance = float(result.state.model.features.contact_distance)
    assert distance == pytest.approx(0.1 * first_state().model.features.length)


def test_a_distance_is_updated_in_units_of_its_first_guess_and_all_else_as_it_was() -> None:
    config = ModelConfig(2, 2, 0.05, 0.02, width=4, learned_contact_distance=False)
    given, model = PRESETS["ours-recurrent"](config, key=jax.random.key(0)), first_state().model
    for in_lengths in (False, True):
        rule = bounded_distance(in_lengths)
        assert rule.update(given, rule.init(given), given)[0] is given
        scaled, _ = rule.update(model, rule.init(model), model)
        distance, length = model.features.contact_distance, model.features.length
        expected = float(distance) * (length if in_lengths else 1.0)
        assert float(scaled.features.contact_distance) == pytest.approx(expected)
        restored = eqx.tree_at(lambda each: each.features.contact_distance, scaled, distance)
        assert_bit_equal(restored, model)


@pytest.mark.slow
def test_a_training_by_the_defaults_learns(recorded: Path, fresh: Path, tmp_path: Path) -> None:
    learned = tmp_path / "run"
    assert cli.run(["train", str(recorded), "--out", str(learned)]) == 0
    model = load_model(learned / "model.safetensors").model
    metrics = evaluate_open_loop(model, read_trajectories(fresh))
    assert metrics["n_step_rmse_m"] < 0.005
    assert metrics["frozen_contact_rmse_m"] is not None
    assert metrics["n_step_rmse_m"] < metrics["frozen_contact_rmse_m"] / 4
    assert metrics["edge_f1"] is not None
    assert metrics["edge_f1"] > 0.97


@pytest.mark.slow
def test_a_short_training_is_what_it_was(recorded: Path, tmp_path: Path) -> None:
    """Bands are wide: platforms round differently, and the difference grows over 300 steps."""
    trained = tmp_path / "run"
    options = ["--model", "ours-recurrent", "--steps", "300"]
    assert cli.run(["train", str(recorded), "--out", str(trained), *options]) == 0
    golden = json.loads(GOLDEN.read_text())
    rows = RunFolder(trained).metrics()
    assert [row["step"] for row in rows] == [row["step"] for row in golden["checks"]]
    for row, expected in zip(rows, golden["checks"], strict=True):
        for name, value in expected.items():
            assert row[name] == pytest.approx(value, rel=0.2), (row["step"], name)
    model = load_model(trained / "model.safetensors").model
    touch = float(model.features.contact_distance)
    assert touch == pytest.approx(golden["touch_distance_m"], rel=0.05)
    theta = float(model.local_dynamics.discretization.theta)
    assert theta == pytest.approx(golden["theta"], abs=0.02)


def test_from_any_checkpoint_on(recorded: Path, straight: tuple, tmp_path: Path) -> None:
    """One check before the rollout joins the loss, and one where it does."""
    parts, path = split(recorded), tmp_path / "checkpoint.safetensors"
    result, checks = straight
    for check in checks[:2]:
        save_checkpoint(path, check.state)
        restored = load_checkpoint(path, first_state(1))
        assert_bit_equal(restored, check.state)
        resumed = trained_on(parts, restored)
        assert_bit_equal(resumed.state, result.state)
        assert resumed.held_out_rmse_m == result.held_out_rmse_m
        assert resumed.status is result.status


def test_the_latest_checkpoint_of_a_folder_holds_the_whole_state(tmp_path: Path) -> None:
    """Every array differs from that of a fresh state, so that none can be left out unnoticed."""
    folder = RunFolder(tmp_path / "run")
    folder.create({}, first_state())
    counter = itertools.count(1)

    def shifted(leaf: object) -> object:
        return leaf + np.asarray(next(counter), leaf.dtype) if eqx.is_array(leaf) else leaf

    states = [jax.tree.map(shifted, first_state()) for _ in range(2)]
    for step, state in enumerate(states, start=1):
        folder.save(FitProgress(step, 2, {}, 1.0, 0.0, state, BASELINES))
    restored = folder.latest(first_state(1))
    assert_bit_equal(restored.optimiser, states[-1].optimiser)
    assert_bit_equal(restored, states[-1])
    assert_bit_equal(load_checkpoint(folder.checkpoints()[0], first_state(1)), states[0])


def rewound(run: Path, to: Path, step: int) -> Path:
    """A copy of a run as it was at a checkpoint, its best model still an older one's."""
    shutil.copytree(run, to)
    folder = RunFolder(to)
    for path in folder.checkpoints():
        if path.name > f"checkpoint-{step:010d}.safetensors":
            path.unlink()
    assert folder.checkpoints()
    (to / "model.safetensors").unlink()
    return to


def rows(run: Path) -> list[dict]:
    return [{**row, "seconds": 0} for row in RunFolder(run).metrics()]


def weights(path: Path) -> dict:
    return {name: a.tobytes() for name, a in safetensors.numpy.load_file(path).items()}


@pytest.mark.parametrize("step", [8, 12])
def test_the_command_leaves_the_same_folder(
    recorded: Path, trained: Path, tmp_path: Path, frequent_checks: None, step: int
) -> None:
    """12 is a training killed between its last checkpoint and its model."""
    run = rewound(trained, tmp_path / "run", step)
    assert cli.run(["train", str(recorded), "--out", str(run), "--resume"]) == 0
    assert rows(run) == rows(trained)
    assert [path.name for path in RunFolder(run).checkpoints()] == [
        path.name for path in RunFolder(trained).checkpoints()
    ]
    for path in [*RunFolder(trained).checkpoints(), trained / "model.safetensors"]:
        assert weights(run / path.name) == weights(path), path.name


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a whole checkpoint"),
        (b"\x08\0\0\0\0\0\0\0{}      ", "not a checkpoint of contactgraph training"),
        (b"nonsense, and a lot of it", "not a whole checkpoint"),
    ],
)
def test_a_damaged_checkpoint(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(content)
    with pytest.raises(InvalidInputError, match=message):
        load_checkpoint(path, first_state())


def test_a_truncated_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, first_state())
    whole = path.read_bytes()
    for share in (0.01, 0.5, 0.999):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InvalidInputError, match="not a whole checkpoint"):
            load_checkpoint(path, first_state())


def test_a_run_that_cannot_be_resumed(recorded: Path, trained: Path, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    with pytest.raises(InvalidInputError, match="has no checkpoint to resume from"):
        folder.latest(first_state())
    with pytest.raises(InvalidInputError, match="not a run folder"):
        folder.config()
    (tmp_path / "metrics.jsonl").write_text(json.dumps({"step": 1}) + "\n")
    with pytest.raises(InvalidInputError, match="line 1 must have a number 'held_out_rmse_m'"):
        folder.metrics()
