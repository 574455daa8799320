"""Springs and dampers between nodes, summed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
from model_scenes import DT

from contactgraph.data.graph import pair_indices
from contactgraph.model import CoupledHead, PerDegreeHead
from contactgraph.model.geometry import geometry

WIDTH, LENGTH, NODES = 6, 0.1, 3
PAIRS = pair_indices(NODES)


def inputs():
    keys = jax.random.split(jax.random.PRNGKey(0), 5)
    position = 0.1 * jax.random.normal(keys[0], (NODES, 2))
    velocity = jax.random.normal(keys[1], (NODES, 2))
    seen = geometry(position, velocity, jnp.asarray(PAIRS), DT, LENGTH)
    embedding = jax.random.normal(keys[2], (NODES, WIDTH))
    message = jax.random.normal(keys[3], (1, 2, len(PAIRS), WIDTH))
    weight = jnp.array([[1.0], [0.4], [0.0]])
    return embedding, message, weight, seen, position, velocity


def test_coupled_springs_and_dampers_by_hand() -> None:
    head = CoupledHead(WIDTH, length=LENGTH, dt=DT, key=jax.random.PRNGKey(1))
    embedding, message, weight, seen, x, v = inputs()
    found = head(embedding, message, weight, seen, x, v)
    softplus = jax.nn.softplus
    for node in range(NODES):
        own = head.node(embedding[node])
        ground = softplus(own[1] - 4) / DT
        kappa, gamma, pull, drag, shift = 0.0, ground, 0.0, 0.0, 0.0
        for edge, ends in enumerate(PAIRS):
            if node not in ends:
                continue
            way = list(ends).index(node)
            other = ends[1 - way]
            out, active = head.edge(message[0, way, edge]), weight[edge, 0]
            stiffness = active * softplus(out[0] - 4) / DT**2
            damping = active * softplus(out[1]) / DT
            rest = active * softplus(out[2]) * LENGTH
            away = (x[other] - x[node]) / jnp.linalg.norm(x[other] - x[node])
            kappa, gamma = kappa + stiffness, gamma + damping
            pull = pull + stiffness * (x[other] - rest * away)
            drag = drag + damping * v[other]
            late = out[3] + out[4] * seen.share_after_touch[edge]
            shift = shift + active * late * DT * (v[other] - v[node])
        close = {"rtol": 1e-4, "atol": 1e-5}
        np.testing.assert_allclose(found.inverse_mass[node], softplus(own[0]) * np.ones(2), **close)
        np.testing.assert_allclose(found.stiffness_rate[node], kappa * np.ones(2), **close)
        np.testing.assert_allclose(found.damping_rate[node], gamma * np.ones(2), **close)
        np.testing.assert_allclose(found.equilibrium[node], pull / kappa, **close)
        np.testing.assert_allclose(found.equilibrium_velocity[node], drag / gamma, **close)
        np.testing.assert_allclose(found.shift[node], shift, **close)


def test_an_untouched_node_has_no_spring_and_only_the_ground_to_rub_against() -> None:
    head = CoupledHead(WIDTH, length=LENGTH, dt=DT, key=jax.random.PRNGKey(1))
    embedding, message, weight, seen, x, v = inputs()
    found = head(embedding, message, 0 * weight, seen, x, v)
    assert not np.any(found.stiffness_rate) and not np.any(found.shift)
    np.testing.assert_array_equal(found.equilibrium, x)
    np.testing.assert_allclose(found.equilibrium_velocity, 0 * v, atol=1e-6)


def test_the_papers_head_is_bounded_and_still_at_its_damper() -> None:
    head = PerDegreeHead(WIDTH, 2, key=jax.random.PRNGKey(1))
    found = head(*inputs())
    for rate in (found.inverse_mass, found.stiffness_rate, found.damping_rate):
        assert np.all((rate > 0) & (rate < 5))
    assert not np.any(found.equilibrium_velocity) and not np.any(found.shift)
