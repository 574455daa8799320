"""Learning the cost that demonstrations were made by, through a differentiable LQR.

**The policy.** From each state of a demonstration, `lqr_trajectory` solves the linear-quadratic
problem of the next ``H`` steps, with the learned model's dynamics along what was done. That is what
model predictive control with this cost would plan there, if it met the same contacts.

**The loss.** What was planned against what was done, states and controls, each in units of how much
they vary in the demonstrations; step ``t`` of a window counts ``discount**t``, since a controller
that plans anew acts on the first steps. A control that was at its limit tells that the limit held
it, no more: there it is held in the plan, too.

**What is learned.** With ``z`` the relative coordinates of `contactgraph.control.relative_form`,
``Q = T^T W T``, ``W = S L L^T S`` and ``R = Lu Lu^T``, ``L`` and ``Lu`` lower triangular and free:
every symmetric positive semi-definite Q and R, and no other. ``S`` (fixed) carries the units. A
cost is known up to a factor, which the mean of R's diagonal settles: it is 1/N^2.

**The prior.** Demonstrations with one goal, and objects in one place, leave much of Q open: a pull
towards the object and a pull towards some point relative to the goal are the same. What transfers
to other goals are terms that stand for themselves: gripper to object, object to goal, alike along
all axes on which nothing falls. The share of ``W`` that is not of this form costs
``prior_weight`` times its square: it stays where the demonstrations call for it.

Source: the paper's cost learning (its section of that name), which follows Amos et al. 2018,
"Differentiable MPC for End-to-end Planning and Control"; prior and basis are ours.
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from contactgraph.control.control_step import ControlLimits
from contactgraph.control.cost_recipe import CostRecipe
from contactgraph.control.demonstrations import demonstrations_of, window_starts
from contactgraph.control.fit_cost import fit_cost
from contactgraph.control.learned_cost import LearnedCost
from contactgraph.control.participants import follow_all, participants
from contactgraph.control.relative_form import alike_axes
from contactgraph.data import Dataset, InvalidInputError
from contactgraph.model import StepModel

_DEFAULT = CostRecipe()


def learn_cost(
    model: StepModel,
    demonstrations: Dataset,
    recipe: CostRecipe = _DEFAULT,
    *,
    goal: Sequence[float] | np.ndarray | None = None,
    limits: ControlLimits | None = None,
    seed: int = 0,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
) -> LearnedCost:
    """Q and R with which the model's optimal plans are what the demonstrations do.

    Nodes that take part in none of them are left out (`participants`). ``goal`` [D] m: in place of
    the runs' own. ``limits``: those that the controls were subject to; where one was at a limit, it
    tells no more than that. None: there were none. ``seed`` and ``on_step`` are `fit_cost`'s.

    Raises `InvalidInputError` where a run has no control or no goal, is shorter than the horizon,
    does not fit the model, touches nothing or lacks a node; and where Q or R loses its
    definiteness, with the step and the smallest eigenvalue.
    """
    scene = demonstrations.trajectories[0].scene
    place = None if goal is None else np.asarray(goal, dtype=np.float64)
    if place is not None and (place.shape != (scene.dimension,) or not np.isfinite(place).all()):
        raise InvalidInputError(f"goal must be {scene.dimension} finite numbers [m], found {goal}")
    starts = window_starts(demonstrations, recipe.horizon)
    followed = follow_all(model, demonstrations)
    found = participants(demonstrations, followed)
    kept = tuple(each.name for each in found if each.kept)
    data = demonstrations_of(demonstrations, followed, kept, place, limits)
    alike = alike_axes(scene.gravity, scene.dimension)
    fitted = fit_cost(data, starts, alike, recipe, seed, on_step)
    return LearnedCost(
        Q=fitted.Q,
        R=fitted.R,
        goal=data.goal[0, : scene.dimension],
        nodes=jnp.asarray([scene.node_name.index(name) for name in kept], jnp.int32),
        kept_nodes=kept,
        history=fitted.history,
        participants=found,
    )
