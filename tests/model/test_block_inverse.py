"""The matrix by groups: the numbers and the derivatives of the whole."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import jitted_geometry
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from contactgraph.bodies.mass_matrix import MassMatrix, solve_dense, spd_inverse
from contactgraph.data.graph import pair_indices
from contactgraph.large_scenes.block_inverse import find_groups, solve_block_diagonal

COUNT = 7


def scene(hinges: bool) -> tuple[MassMatrix, jnp.ndarray]:
    """Two groups, of three and of two, and two nodes alone, every pair an edge."""
    rng = np.random.default_rng(3)
    pairs = pair_indices(COUNT)
    position, velocity = rng.normal(size=(2, COUNT, 2))
    anchor = None
    if hinges:
        hung = np.full((COUNT, 2), np.nan)
        hung[[1, 4]] = rng.normal(size=(2, 2))
        anchor = jnp.asarray(hung)
    states = map(jnp.asarray, (position, velocity, pairs.T))
    edge_geometry = jitted_geometry(*states, 0.05, 0.08, anchor=anchor)
    holding = {(0, 4), (2, 4), (1, 6)}
    holds = np.array([tuple(pair) in holding for pair in pairs.tolist()])
    stiff = jnp.asarray(np.where(holds, rng.uniform(1, 9, len(pairs)), 0.0))
    size, columns = (2, 3) if hinges else (1, 4)
    node = np.tile(rng.uniform(0.5, 2.0, (COUNT, 1)), size)
    matrix = MassMatrix(jnp.asarray(node), stiff, edge_geometry)
    return matrix, jnp.asarray(rng.normal(size=(COUNT, size, columns)))


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("hinges", [False, True])
def test_values_and_derivatives_are_those_of_the_whole(hinges: bool) -> None:
    matrix, vectors = scene(hinges)

    def by(solve):
        def total(node, stiff, edge_jacobian, vectors):
            edge_geometry = dataclasses.replace(matrix.rows, contact_jacobian=edge_jacobian)
            solved = solve(MassMatrix(node, stiff, edge_geometry), vectors)
            weights = jnp.arange(1.0, 1.0 + solved.solution.size).reshape(solved.solution.shape)
            share = jnp.arange(1.0, COUNT + 1.0)[:, None]
            return jnp.sum(jnp.sin(weights) * solved.solution) + jnp.sum(
                share * solved.diagonal
            ), solved

        arguments = (matrix.node, matrix.edge, matrix.rows.contact_jacobian, vectors)
        return jax.jit(jax.grad(total, argnums=(0, 1, 2, 3), has_aux=True))(*arguments)

    derivatives, solved = by(solve_dense)
    grouped_derivatives, grouped = by(
        lambda *arguments: solve_block_diagonal(*arguments, capacity=4)
    )
    close = {"rtol": 1e-9, "atol": 1e-10}
    np.testing.assert_allclose(grouped.solution, solved.solution, **close)
    np.testing.assert_allclose(grouped.diagonal, solved.diagonal, **close)
    # Edges that hold nothing would join groups if they held: these have derivatives, too.
    idle = np.asarray(matrix.edge) == 0
    assert (np.abs(np.asarray(derivatives[1])[idle]) > 1e-6).all()
    node, stiff, edge_jacobian, right = zip(grouped_derivatives, derivatives, strict=True)
    for found, expected in (node, stiff, right):
        np.testing.assert_allclose(found, expected, **close)
    if hinges:  # levers of one row are ones, and no variables
        np.testing.assert_allclose(*edge_jacobian, **close)


@pytest.mark.slow
def test_a_group_beyond_capacity_has_no_solution() -> None:
    matrix, vectors = scene(hinges=False)
    assert np.isfinite(solve_block_diagonal(matrix, vectors, capacity=3).solution).all()
    assert np.isnan(solve_block_diagonal(matrix, vectors, capacity=2).solution).all()


def test_groups_are_connected_components() -> None:
    rng = np.random.default_rng(0)
    count, edges = 60, 100
    ends = rng.integers(0, count, (2, edges)).astype(np.int32)
    for share in (0.0, 0.2, 0.5, 1.0):
        joins = rng.random(edges) < share
        found = jax.jit(find_groups, static_argnums=2)(joins, ends, count)
        group, slot = np.asarray(found.group), np.asarray(found.slot)
        matrix = coo_matrix((joins[joins], ends[:, joins]), (count, count))
        _, label = connected_components(matrix, directed=False)
        np.testing.assert_array_equal(group[:, None] == group, label[:, None] == label)
        for one in np.unique(group):
            members = np.flatnonzero(group == one)
            assert one == members[0]
            assert sorted(slot[members]) == list(range(len(members)))
        assert int(found.largest) == np.bincount(label).max()


def test_inverses_side_by_side() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(5, 4, 4))
    matrix = np.tile(np.eye(6), (5, 1, 1))
    matrix[:, :4, :4] = root @ np.swapaxes(root, 1, 2) + 0.5 * np.eye(4)
    found = jax.jit(spd_inverse)(jnp.asarray(matrix, jnp.float32), 4)
    np.testing.assert_allclose(found, np.linalg.inv(matrix), rtol=2e-3, atol=2e-4)
