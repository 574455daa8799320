"""The loop that learns a cost from states, controls and linear dynamics, whatever made them."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.control.cost_learner import advance_learner, cost_learner
from contactgraph.control.cost_recipe import CostRecipe
from contactgraph.control.demonstrations import Demonstrations
from contactgraph.control.learned_cost import LearningHistory
from contactgraph.data import InvalidInputError

_CHUNK = 50
"""Steps in one compiled call."""
_LEAST = 1e-5
"""R's smallest eigenvalue; their mean is 1."""


@dataclass(frozen=True, eq=False)
class FittedCost:
    """What `fit_cost` finds."""

    Q: Float[Array, "m m"]
    R: Float[Array, "U U"]
    history: LearningHistory


def fit_cost(
    data: Demonstrations,
    starts: np.ndarray,
    alike: np.ndarray,
    recipe: CostRecipe,
    seed: int = 0,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
) -> FittedCost:
    """Q and R whose optimal plans from the states ``starts`` [W, 2] (run, step) are the data.

    ``alike`` [D, D]: `alike_axes`. ``seed``: of the order of windows. ``on_step`` is told, every
    50 steps, the steps done and the imitation loss. Raises `InvalidInputError` where Q or R loses
    its definiteness, with the step and the smallest eigenvalue.
    """
    learner = cost_learner(data, starts, recipe, alike)
    order = np.random.default_rng(seed).integers(len(starts), size=(recipe.steps, recipe.batch))
    state = learner.begin()
    told: list[LearningHistory] = []
    for begin in range(0, recipe.steps, _CHUNK):
        windows = jnp.asarray(starts[order[begin : begin + _CHUNK]])
        state, history = advance_learner(learner, data, state, windows)
        _check_definite(history, begin)
        told.append(history)
        on_step(begin + len(windows), float(np.mean(history.imitation)))
    Q, R, _ = learner.cost(state.free)
    history = jax.tree.map(lambda *parts: jnp.concatenate(parts), *told)
    return FittedCost(0.5 * (Q + Q.T), 0.5 * (R + R.T), history)


def _check_definite(history: LearningHistory, begin: int) -> None:
    """Raises `InvalidInputError` where Q is not positive semi-definite or R not positive."""
    for name, smallest, least in (
        ("R", np.asarray(history.smallest_r), _LEAST),
        ("Q", np.asarray(history.smallest_q), 0.0),
    ):
        lost = ~(smallest >= least)
        if lost.any():
            step = int(np.argmax(lost))
            raise InvalidInputError(
                f"learning the cost stopped at step {begin + step + 1}: {name}'s smallest "
                f"eigenvalue is {smallest[step]:.3g}; a smaller learning rate may help"
            )
