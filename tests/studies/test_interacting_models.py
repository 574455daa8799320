"""The filter of interacting models in `benchmarks`, on pairs whose modes are known."""

from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from contactgraph.data import Dataset, Scene, Trajectory

DT = 0.05
STEPS = 60


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("filterpy")
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    import interacting_models

    return interacting_models


def pair(held: slice, pressing: slice = slice(0, 0), apart: slice = slice(0, 0)) -> Trajectory:
    """A gripper that swings beside a body, which it holds, presses or does not touch for a time."""
    position = np.zeros((STEPS + 1, 2, 2))
    position[:, 1, 0] = 0.08
    position[apart, 1, 0] = 0.2
    contact = np.zeros((STEPS + 1, 2, 2), bool)
    contact[held, 0, 1] = contact[held, 1, 0] = True
    velocity = np.zeros((STEPS + 1, 2, 2))
    velocity[:, 0, 1] = 0.3 * np.sin(0.4 * np.arange(STEPS + 1))
    velocity[pressing, 0, 0] = 0.1
    for state in range(1, STEPS + 1):
        velocity[state, 1] = velocity[state, 0] if contact[state, 0, 1] else velocity[state - 1, 1]
        velocity[state, 1, 0] = max(velocity[state, 1, 0], velocity[state, 0, 0])
    names = ("gripper", "target")
    scene = Scene(
        names, ("gripper", "object"), np.array([True, False]), DT, radius=np.full(2, 0.04)
    )
    return Trajectory(scene, position, velocity, np.zeros((STEPS, 2)), contact, holding=contact)


def test_the_right_mode_is_found(benchmark: ModuleType) -> None:
    run = pair(held=slice(20, 40), pressing=slice(5, 10), apart=slice(50, 61))
    chain = benchmark.ModeChain(np.array([0.5, 0.5]), np.array([[0.95, 0.05], [0.05, 0.95]]))
    found = benchmark.held_probability(run, 1, chain)
    assert found[0] == 0.5
    assert (found[2:20] < 0.01).all(), "pressing is no hold"
    assert (found[22:40] > 0.9).all() and (found[42:50] < 0.01).all()
    assert (found[50:] < 1e-6).all(), "apart"


def test_transitions_are_counted(benchmark: ModuleType) -> None:
    run = pair(held=slice(20, 40), apart=slice(50, 55))
    chain = benchmark.ModeChain.counted(Dataset((run,)))
    # Of 50 and 6 touching states in a row; it begins once, after being apart, as free.
    free, held = np.array([33.5, 1.5]), np.array([1.5, 19.5])
    assert chain.transition == pytest.approx(np.stack([free / 35.0, held / 21.0]))
    assert chain.begin == pytest.approx([0.75, 0.25])


def test_what_is_likely_is_held(benchmark: ModuleType) -> None:
    """From a window's start the chain decides, for each body that the gripper touches."""
    chain = benchmark.ModeChain(np.array([0.8, 0.2]), np.array([[0.9, 0.1], [0.4, 0.6]]))
    models = benchmark.InteractingModels(pair(held=slice(20, 61)), chain)
    joined: set[int] = set()
    lasting: list[bool] = []
    world = SimpleNamespace(
        touching_pairs={(0, 1)},
        joined_pairs=frozenset(),
        join=lambda first, second: joined.add(second),
        part=lambda first, second: joined.discard(second),
    )
    models.redraw(world, 30, None)
    assert joined == {1}
    for _ in range(3):  # steps, after which 0.57, 0.39 and 0.29 are left
        for _ in range(10):
            world.hold.update(world, 0.005)
        lasting.append(bool(joined))
    assert lasting == [True, False, False]
    drawn = []
    for seed in range(400):
        joined.clear()
        models.redraw(world, 30, np.random.default_rng(seed))
        for _ in range(20):
            world.hold.update(world, 0.005)
        drawn.append(bool(joined))
    assert np.mean(drawn) == pytest.approx(0.2 + 0.8 * 0.5**2.1, abs=0.06)
