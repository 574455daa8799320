"""The picture of a cost: its blocks have names, and colours and numbers that can be trusted."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

from contactgraph.control import LearnedCost, QuadraticCost, chain_cost
from contactgraph.data import InvalidInputError
from contactgraph.viz import cost_figure

PICK, GOAL = [3.0, 3.0, 0.2, 0.2], [50.0, 50.0, 1.0, 1.0]


def own(control_weight: float = 0.01) -> QuadraticCost:
    """Of a scene of three nodes, whose middle one takes no part."""
    return chain_cost([2, 0], PICK, GOAL, control_weight, [0.1, 0.2], 3)


def a_cost(names: tuple[str, ...] = ("gripper", "target"), dimension: int = 2) -> LearnedCost:
    rng = np.random.default_rng(0)
    L = rng.normal(size=(2 * dimension * len(names),) * 2)
    return LearnedCost(
        Q=jnp.asarray(4.0 * L @ L.T),
        R=4.0 * jnp.eye(dimension),
        goal=jnp.zeros(dimension),
        nodes=jnp.asarray([2, 0, *range(3, 1 + len(names))], jnp.int32),
        kept_nodes=names,
        imitation_loss=jnp.ones(1),
    )


def shown(figure: Figure) -> list[np.ndarray]:
    """The matrices in the picture, in the order they are drawn."""
    return [np.asarray(image.get_array()) for axes in figure.axes for image in axes.images]


def texts(figure: Figure, panel: int) -> list[str]:
    return [text.get_text() for text in figure.axes[panel].texts]


def test_the_cost_is_drawn_relative_to_the_mean_of_r() -> None:
    cost = a_cost()
    Q, W, R = shown(cost_figure(cost))
    assert np.allclose(Q, cost.Q / 4.0)
    assert np.allclose(R, np.eye(2))
    # x_1 = z_1 + z_2 and x_2 = z_2, from the goal on.
    assert np.allclose(W[:4, :4], Q[:4, :4])
    assert np.allclose(W[:4, 4:], Q[:4, :4] + Q[:4, 4:])
    assert np.allclose(W[4:, 4:], Q[:4, :4] + Q[:4, 4:] + Q[4:, :4] + Q[4:, 4:])


def test_the_expert_s_own_cost_is_drawn_below_in_the_same_units() -> None:
    figure = cost_figure(a_cost(), own())
    Q, W, R = shown(figure)[3:]
    assert np.allclose(np.diag(W), 100.0 * np.array([*PICK, *GOAL]), rtol=1e-5)
    assert np.allclose(W, np.diag(np.diag(W)), atol=1e-2), "it has nothing off the diagonal"
    assert np.allclose(Q[:4, 4:], -np.diag(100.0 * np.array(PICK)), rtol=1e-5)
    assert np.allclose(R, np.eye(2))
    assert "5000" in texts(figure, 4) and "\N{MINUS SIGN}300" in texts(figure, 3)
    other = shown(cost_figure(a_cost(), own(control_weight=1.0)))[3]
    assert np.allclose(100.0 * other, Q, rtol=1e-5), "a factor on R alone is another cost"
    learned = shown(cost_figure(a_cost(), a_cost()))
    assert np.array_equal(learned[0], learned[3])


def test_colours_are_the_same_for_both_signs_and_every_matrix() -> None:
    figure = cost_figure(a_cost(), own())
    norms = [image.norm for axes in figure.axes for image in axes.images]
    assert all(norm is norms[0] for norm in norms)
    largest = max(float(np.abs(matrix).max()) for matrix in shown(figure))
    assert norms[0].vmax == pytest.approx(largest) and norms[0].vmin == pytest.approx(-largest)
    assert norms[0](0.0) == pytest.approx(0.5)
    assert norms[0](0.01 * largest) - 0.5 > 0.1, "a hundredth of the largest is to be seen"


def test_an_expert_that_does_not_fit() -> None:
    varying = replace(own(), Q=jnp.stack([own().Q] * 3))
    smaller = chain_cost([0, 1], PICK, GOAL, 0.01, [0.0, 0.0], 2)
    other = chain_cost([2, 0], PICK, GOAL, 0.01, [0.0, 0.0], 3, control_size=3)
    for expert in (varying, smaller, other):
        with pytest.raises(InvalidInputError, match="expert must have one Q for all steps, of at"):
            cost_figure(a_cost(), expert)
