"""Neighbour lists are chosen in large scenes and grow once on overflow."""

import dataclasses
import logging
import math

import jax
import numpy as np
import pytest
from evaluation_worlds import DT, GluedBodies, random_run

from contactgraph.data import Dataset
from contactgraph.evaluate import evaluate_open_loop
from contactgraph.large_scenes import NeighborList, ReallocatingModel, neighbor_list
from contactgraph.model import PRESETS, ModelConfig
from contactgraph.train import FitStatus, TrainConfig, fit, initial_state

COUNT = 6


@pytest.fixture(scope="module")
def apart() -> Dataset:
    """A row of bodies, of which only neighbours are in reach of each other."""
    trajectory = random_run(COUNT, 4, 0)
    row = 0.15 * np.arange(COUNT)[:, None] * np.array([1.0, 0.2])
    return Dataset((dataclasses.replace(trajectory, position=0.3 * trajectory.position + row),))


@pytest.fixture(scope="module")
def model():
    return PRESETS["ours-recurrent"](ModelConfig(2, 2, DT, width=4), key=jax.random.key(0))


@pytest.fixture
def large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few bodies are many."""
    monkeypatch.setattr(neighbor_list, "CELLS_FROM", COUNT)


@pytest.fixture(scope="module")
def sparse() -> Dataset:
    """A longer row."""
    trajectory = random_run(14, 4, 0)
    row = 0.15 * np.arange(14)[:, None] * np.array([1.0, 0.2])
    return Dataset((dataclasses.replace(trajectory, position=0.3 * trajectory.position + row),))


def test_small_scenes_use_neighbor_lists_where_few_pairs_are_near(model, apart, sparse) -> None:
    assert ReallocatingModel(model, apart).model is model
    lists = ReallocatingModel(model, sparse).model.neighbor_list
    assert lists.cell_capacity is None and lists.group_capacity is None
    assert 13 < lists.max_edges < 45


@pytest.mark.slow
def test_neighbor_lists_do_not_change_results_of_small_scenes(
    model, sparse, monkeypatch, caplog
) -> None:
    near = evaluate_open_loop(model, sparse, horizon_s=2 * DT)
    monkeypatch.setattr(neighbor_list, "_MIN_SPARE", -5)
    monkeypatch.setattr(neighbor_list, "_SPARE", 0.3)
    with caplog.at_level(logging.WARNING):
        grown = evaluate_open_loop(model, sparse, horizon_s=2 * DT)
    assert caplog.text.count("compiled again") == 1
    monkeypatch.setattr(neighbor_list, "_MAX_SHARE", 0.0)
    every = evaluate_open_loop(model, sparse, horizon_s=2 * DT)
    for found in (near, grown):
        for name, value in every.to_json().items():
            expected = pytest.approx(value, rel=1e-3) if isinstance(value, float) else value
            assert found.to_json()[name] == expected, name


@pytest.mark.usefixtures("large")
def test_models_get_neighbor_lists_in_large_scenes(model, apart) -> None:
    lists = ReallocatingModel(model, apart)
    assert lists.given is model
    assert lists.model.neighbor_list is not None
    assert COUNT - 1 < lists.model.neighbor_list.max_edges < 1.5 * COUNT * (COUNT - 1) / 2
    given = dataclasses.replace(model, neighbor_list=NeighborList(3, 4))
    for other in (
        given,
        PRESETS["ours-no-inference"](ModelConfig(2, 2, DT, width=4), key=jax.random.key(0)),
        GluedBodies(),
    ):
        assert ReallocatingModel(other, apart).model is other


@pytest.mark.usefixtures("large")
def test_capacity_grows_once_and_is_logged(model, apart, caplog) -> None:
    lists = ReallocatingModel(model, apart)
    rooms = []

    def predict(model) -> int:
        rooms.append(model.neighbor_list)
        return len(rooms)

    assert lists.reallocate_on_overflow(predict, lambda found: found != 1) == 2
    first, grown = rooms
    assert (grown.max_edges, grown.cell_capacity, grown.group_capacity) == (
        4 * first.max_edges,
        4 * first.cell_capacity,
        64,
    )
    assert caplog.text.count("compiled again") == 1
    assert lists.reallocate_on_overflow(predict, lambda found: False) == 3
    assert rooms[2] == grown
    assert caplog.text.count("compiled again") == 1


@pytest.mark.usefixtures("large")
def test_the_given_capacity_is_the_limit(model, apart) -> None:
    given = dataclasses.replace(model, neighbor_list=NeighborList(3, 4))
    calls = []
    ReallocatingModel(given, apart).reallocate_on_overflow(calls.append, lambda found: False)
    assert calls == [given]


@pytest.mark.slow
def test_open_loop_errors_are_those_of_all_pairs(model, apart, monkeypatch, caplog) -> None:
    every = evaluate_open_loop(model, apart, horizon_s=2 * DT)
    monkeypatch.setattr(neighbor_list, "CELLS_FROM", COUNT)
    monkeypatch.setattr(neighbor_list, "_SPARE", 0.3)
    with caplog.at_level(logging.WARNING):
        near = evaluate_open_loop(model, apart, horizon_s=2 * DT)
    assert caplog.text.count("compiled again") == 1
    assert near["diverged_windows"] == every["diverged_windows"] == 0
    for name, value in every.to_json().items():
        expected = pytest.approx(value, rel=1e-3) if isinstance(value, float) else value
        assert near.to_json()[name] == expected, name


@pytest.mark.slow
@pytest.mark.usefixtures("large")
def test_training_in_large_scenes_uses_neighbor_lists(model, apart) -> None:
    config = TrainConfig(steps=1, batch_size=2, window_length=2, rollout_from=1.0, bystanders=0)
    state = initial_state(model, config, 0)
    result = fit(state, apart, apart, config, near_pairs=ReallocatingModel)
    assert result.status is FitStatus.finished
    assert math.isfinite(result.held_out_rmse_m)
    # What was learned is a model for scenes of any size.
    assert result.model.neighbor_list is None and result.state.model.neighbor_list is None
    assert jax.tree.structure(result.state) == jax.tree.structure(state)
