"""A batch along the last axis: the results of `jax.vmap`, whatever the operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.control.lanes import in_lanes

LANES = 5
MATRIX = np.random.default_rng(0).normal(size=(9, 9)).astype(np.float32)
ROWS = np.array([2, 0, 1])


def products(x, y, i):
    """With a matrix of all lanes from both sides, of lanes, in batches, and small ones."""
    square = x[:, None] * y[None] + jnp.eye(9)
    batched = jnp.einsum("bij,bjk->bik", square.reshape(3, 3, 9), MATRIX.reshape(3, 9, 3))
    long = jnp.tile(square, (1, 4))  # sums of 36 terms
    return (
        *(MATRIX @ square, square @ MATRIX, square @ square.T, batched, MATRIX[:2, :3] @ x[:3]),
        *(long @ long.T, jnp.sum(long * y[:, None], axis=1)),
    )


def indexed(x, y, i):
    """By numbers of all lanes and of each, in reads and writes, and in rows of a table."""
    table = jnp.stack([x, y, x * y])
    written = table.at[ROWS].set(0.5 * table).at[0].multiply(y).at[1, 2].add(x[3])
    return (
        table[i],
        table[ROWS],
        table[:, i + 1],
        written,
        table.at[i].set(0.0),
        jnp.asarray(MATRIX)[i],
    )


def reshaped(x, y, i):
    both = jnp.concatenate([x, y, jnp.ones(3)]).reshape(3, 7).T
    first, *_ = jnp.split(both, [2], axis=0)
    return jnp.pad(both, ((1, 0), (0, 2))), first, both[::2, 1:], jnp.flip(both, 1), both.max(0)


def elementwise(x, y, i):
    chosen = jnp.where(i > 1, x, y)
    return jnp.clip(chosen, x[0], 1.0), jnp.cumsum(x), jnp.sum(MATRIX * x), jnp.argmax(y), i + 1


def unknown(x, y, i):
    solved = jnp.linalg.solve(MATRIX + jnp.outer(x, x), y)
    return jnp.sort(x), solved, jax.lax.cond(i > 1, lambda: x, lambda: y)


def loops(x, y, i):
    """What starts equal in all lanes and comes to differ, and what stays equal."""

    def step(carry, row):
        one, other, count = carry
        return (jnp.tanh(one + row), other + one, count + 1), (other[count], count)

    scanned = jax.lax.scan(step, (x, jnp.zeros(9), 0), MATRIX)
    until = jax.lax.while_loop(lambda c: c[0] < i, lambda c: (c[0] + 1, 2 * c[1] + x), (0, y))
    times = jax.lax.fori_loop(0, jnp.sum(jnp.asarray(ROWS)), lambda j, c: c.at[j].add(x[j]), y)
    return scanned, until, times


@pytest.mark.parametrize("function", [products, indexed, reshaped, elementwise, unknown, loops])
def test_the_results_are_those_of_vmap(function):
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(2, 9, LANES)).astype(np.float32)
    i = np.arange(LANES) % 3
    mapped = jax.jit(jax.vmap(function, in_axes=-1, out_axes=-1))(x, y, i)
    ours = jax.jit(in_lanes(function, LANES))(x, y, i)
    assert jax.tree.structure(ours) == jax.tree.structure(mapped)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(mapped), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)
