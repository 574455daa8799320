"""Training in scenes large enough for neighbour lists: the loss and gradient of all pairs."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import window_of

from contactgraph.data import TrajectoryBatch
from contactgraph.large_scenes import NeighborList
from contactgraph.model import PRESETS, ContactDynamics, ModelConfig
from contactgraph.train import LossTerms, batch
from contactgraph.train.window_loss import rollout_loss, window_loss

COUNT, STEPS = 5, 3


def windows() -> TrajectoryBatch:
    """Two windows of bodies that move through each other, some in reach and some not."""
    rng = np.random.default_rng(0)
    velocity = np.repeat(rng.normal(size=(2, 1, COUNT, 2)), STEPS + 1, axis=1)
    position = rng.uniform(-0.4, 0.4, (2, 1, COUNT, 2)) + 0.05 * np.cumsum(velocity, axis=1)
    return window_of(position, velocity, rng.normal(size=(2, STEPS, 2)))


@eqx.filter_jit
@eqx.filter_value_and_grad
def loss_and_gradient(
    model: ContactDynamics, drawn: TrajectoryBatch, devices: int = 1, edges: int | None = None
) -> jax.Array:
    """`edges`, set by a test in `contactgraph.train.batch`, makes it another program."""
    terms = window_loss(model, drawn, jax.random.key(0), devices)
    terms = dataclasses.replace(terms, rollout=rollout_loss(model, drawn, devices))
    return terms.total(LossTerms())


@pytest.fixture(scope="module")
def of_all_pairs() -> tuple:
    """A model, four windows, and their loss and gradient."""
    model = PRESETS["ours-recurrent"](ModelConfig(2, 2, 0.05, width=8), key=jax.random.key(1))
    drawn = jax.tree.map(
        lambda leaf: jnp.concatenate([leaf, 0.9 * leaf]).astype(leaf.dtype), windows()
    )
    return model, drawn, loss_and_gradient(model, drawn)


@pytest.mark.slow
@pytest.mark.parametrize("lists", [NeighborList(9, 5, 5), NeighborList(9, None, None)])
def test_loss_and_gradient_are_those_of_all_pairs(lists: NeighborList, of_all_pairs: tuple) -> None:
    model, drawn, (value, gradient) = of_all_pairs
    near = dataclasses.replace(model, neighbor_list=lists)
    near_value, near_gradient = loss_and_gradient(near, drawn)
    assert np.isfinite(value)
    np.testing.assert_allclose(near_value, value, rtol=1e-5)
    for found, expected in zip(
        jax.tree.leaves(near_gradient), jax.tree.leaves(gradient), strict=True
    ):
        scale = float(np.abs(expected).max())
        np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-5 + 1e-3 * scale)


@pytest.mark.slow
def test_chunk_after_chunk_is_all_at_once(
    monkeypatch: pytest.MonkeyPatch, of_all_pairs: tuple
) -> None:
    model, drawn, (at_once, gradient) = of_all_pairs
    monkeypatch.setattr(batch, "_EDGES", 30)  # chunks that do not come out even
    for devices in (1, 2):
        value, found = loss_and_gradient(model, drawn, devices, 30)
        np.testing.assert_allclose(value, at_once, rtol=1e-5)
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(gradient), strict=True):
            scale = float(np.abs(other).max())
            np.testing.assert_allclose(one, other, rtol=2e-3, atol=1e-5 + 1e-3 * scale)


@pytest.mark.parametrize("devices", [1, 2])
@pytest.mark.parametrize("edges", [1, 70, 200])
def test_a_chunked_function_is_the_function_of_every_item(devices: int, edges: int) -> None:
    """Chunks of all items, of a few with a remainder, and of one."""
    x, y = np.random.default_rng(0).normal(size=(2, 14, 3)).astype(np.float32)

    def function(item: jax.Array, other: tuple[jax.Array]) -> dict[str, jax.Array]:
        return {"sum": jnp.sum(item * other[0]), "sine": jnp.sin(item)}

    def total(x: jax.Array) -> jax.Array:
        found = batch.chunked_vmap(function, x, (y,), edges=edges, devices=devices)
        return jnp.sum(found["sum"] * jnp.arange(14.0)) + jnp.sum(found["sine"])

    expected = np.sum(np.sum(x * y, axis=1) * np.arange(14.0)) + np.sum(np.sin(x))
    value, gradient = jax.jit(jax.value_and_grad(total))(x)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    np.testing.assert_allclose(gradient, y * np.arange(14.0)[:, None] + np.cos(x), rtol=1e-5)
