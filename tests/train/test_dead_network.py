"""Dead networks end a training; healthy ones do not."""

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from training import BASELINES, CONFIG, first_state, split, trained_on

from contactgraph.bodies.message_passing import EdgeNetwork, MessagePassing
from contactgraph.data import TrajectoryBatch, pad_trajectories
from contactgraph.model import PRESETS, ContactDynamics, ModelConfig
from contactgraph.model.paper.presets import PAPER_PRESETS, full_ab, paper_literal
from contactgraph.model.presets import Preset
from contactgraph.train import FitStatus
from contactgraph.train.batch import window_source
from contactgraph.train.held_out import equals_constant_velocity, has_dead_units, mean_rmse
from contactgraph.train.window_loss import WindowObjective

DT = 0.05
CONFIGURATION = ModelConfig(2, 2, DT, width=8)


@pytest.fixture(scope="module")
def windows(recorded: Path) -> TrajectoryBatch:
    batch = pad_trajectories(split(recorded)[0], contacts=False)
    return window_source(batch, 3, 0.6).draw(32, jax.random.key(0))


def killed(model: ContactDynamics, layer: Callable[[ContactDynamics], jax.Array]):
    """The model with a layer's bias so low that its units are never active."""
    return eqx.tree_at(layer, model, jnp.full_like(layer(model), -1e3))


def edge_layer(index: int) -> Callable[[ContactDynamics], jax.Array]:
    return lambda model: model.inference.message_passing.network.layers[index].bias


def local_messages(model: ContactDynamics) -> MessagePassing | EdgeNetwork:
    return model.local_dynamics.message_passing.types[0]


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_a_layer_that_is_never_active_is_dead(windows: TrajectoryBatch, layer: int) -> None:
    model = PRESETS["ours-recurrent"](CONFIGURATION, key=jax.random.key(0))
    assert not has_dead_units(model, windows)
    assert has_dead_units(killed(model, edge_layer(layer)), windows)


@pytest.mark.parametrize(
    ("preset", "layer"),
    [
        (PRESETS["ours-memoryless"], edge_layer(0)),
        (
            PRESETS["ours-no-inference"],
            lambda model: model.local_dynamics.message_passing.types[0].network.layers[2].bias,
        ),
        (full_ab, lambda model: model.inference.message_passing.steps[1].message.bias),
        (paper_literal, lambda model: model.inference.message_passing.steps[1].receiver.bias),
        (
            PAPER_PRESETS["paper-literal-no-gim"],
            lambda model: local_messages(model).steps[1].message.bias,
        ),
    ],
)
def test_every_kind_of_network_is_watched(
    preset: Preset, layer: Callable, windows: TrajectoryBatch
) -> None:
    model = preset(CONFIGURATION, key=jax.random.key(0))
    assert not has_dead_units(model, windows)
    assert has_dead_units(killed(model, layer), windows)


def test_local_dynamics_may_treat_all_edges_alike_where_edges_are_inferred(
    windows: TrajectoryBatch,
) -> None:
    """Bodies that are always held rigidly need no more than one coupling."""
    model = PRESETS["ours-recurrent"](CONFIGURATION, key=jax.random.key(0))
    model = killed(model, lambda model: local_messages(model).network.layers[2].bias)
    assert not has_dead_units(model, windows)


def test_nothing_is_said_about_bodies_that_are_never_near_or_all_alike(
    windows: TrajectoryBatch,
) -> None:
    dead = killed(PRESETS["ours-recurrent"](CONFIGURATION, key=jax.random.key(0)), edge_layer(2))
    far = windows.position.at[:, :, 1].add(9.0)
    assert not has_dead_units(dead, windows._replace(position=far))
    alike = jax.tree.map(jnp.zeros_like, (windows.position, windows.velocity))
    still = windows._replace(position=alike[0], velocity=alike[1])
    assert not has_dead_units(dead, still)


@pytest.mark.usefixtures("trained")  # it compiles what the test runs
def test_a_training_with_dead_units_stops_at_its_first_check(recorded: Path) -> None:
    state = first_state()
    state = dataclasses.replace(state, model=killed(state.model, edge_layer(1)))
    checks = []
    result = trained_on(split(recorded), state, checks.append)
    assert result.status is FitStatus.dead_units
    assert [check.step for check in checks] == [CONFIG.check_every], "its check is still saved"
    assert result.held_out_rmse_m == checks[0].held_out_rmse_m


@pytest.mark.parametrize(
    ("error", "best", "done", "dead"),
    [
        (2.0, 2.0, 0.5, True),
        (2.0 * 1.0009, 2.0, 0.9, True),
        (2.0 * 0.9991, 2.0 * 0.9991, 0.9, True),
        (2.0, 2.0, 0.49, False),  # too early to judge
        (2.0 * 0.998, 2.0 * 0.998, 0.9, False),  # it learns, if little
        (2.0 * 1.002, 2.0, 0.9, False),  # it moves
        (2.0, 1.9, 0.9, False),  # it was better before
    ],
)
def test_an_error_equal_to_constant_velocity_is_dead(
    error: float, best: float, done: float, dead: bool
) -> None:
    assert equals_constant_velocity(error, best, BASELINES, done) is dead


@pytest.mark.parametrize(
    ("constant_velocity", "dead"), [(0.0, False), (0.002, False), (0.004, True)]
)
def test_bodies_that_move_uniformly_leave_nothing_to_learn(
    constant_velocity: float, dead: bool
) -> None:
    uniform = dataclasses.replace(BASELINES, constant_velocity_rmse_m=constant_velocity)
    assert equals_constant_velocity(constant_velocity, constant_velocity, uniform, 1.0) is dead


def test_a_training_at_constant_velocity_stops_half_way(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def advance(self, state, data, count, neighbor_list):
        after = dataclasses.replace(state, step=state.step + count)
        return after, {"prediction": jnp.ones(())}

    def rmse(model, windows, belief, counted):
        position, ahead = windows.position, DT * jnp.arange(1, windows.position.shape[1])
        moved = position[:, :1] + ahead[:, None, None] * windows.velocity[:, :1]
        return mean_rmse(jnp.sum((moved - position[:, 1:]) ** 2, axis=-1), counted)

    monkeypatch.setattr(WindowObjective, "advance", advance)
    monkeypatch.setattr(importlib.import_module("contactgraph.train.fit"), "_rollout_rmse", rmse)
    checks = []
    result = trained_on(split(recorded), first_state(), checks.append)
    assert result.status is FitStatus.constant_velocity
    assert [check.step for check in checks] == [4, 8]
    assert not result.is_better
