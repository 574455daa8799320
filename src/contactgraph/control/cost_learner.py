"""The loss of a cost against demonstrations, and the steps that lower it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from contactgraph.control.cost_recipe import CostRecipe
from contactgraph.control.demonstrations import Demonstrations
from contactgraph.control.differentiable_lqr import lqr_trajectory, tracking_problem
from contactgraph.control.learned_cost import ROUNDING, LearningHistory
from contactgraph.control.relative_form import independent_part, relative_basis
from contactgraph.data import InvalidInputError


class FreeCost(eqx.Module):
    """The numbers that are learned."""

    L: Float[Array, "m m"]
    Lu: Float[Array, "U U"]


class LearnerState(eqx.Module):
    """What is carried from step to step."""

    free: FreeCost
    optimiser: optax.OptState


class CostLearner(eqx.Module):
    """What stays the same while a cost is learned."""

    basis: Float[Array, "m m"]
    """T"""
    units: Float[Array, " m"]
    """S: such that L = 1 answers a usual error with a usual control."""
    alike: Float[Array, "D D"]
    state_weight: Float[Array, "H+1 m"]
    control_weight: Float[Array, "H U"]
    recipe: CostRecipe = eqx.field(static=True)

    def begin(self) -> LearnerState:
        """Before the first step: a usual error is answered with a usual control."""
        m, U = self.basis.shape[0], self.control_weight.shape[1]
        dtype = self.basis.dtype
        free = FreeCost(jnp.eye(m, dtype=dtype), jnp.eye(U, dtype=dtype))
        return LearnerState(free, self.optimiser().init(free))

    def optimiser(self) -> optax.GradientTransformation:
        """Adam, with a rate that falls to zero."""
        recipe = self.recipe
        return optax.adam(optax.cosine_decay_schedule(recipe.learning_rate, recipe.steps))

    def cost(self, free: FreeCost) -> tuple[Array, Array, Array]:
        """Q, R, and the relative terms without units."""
        L, Lu = jnp.tril(free.L), jnp.tril(free.Lu)
        W = L @ L.T
        R = Lu @ Lu.T
        scaled = self.units[:, None] * W * self.units[None, :]
        return self.basis.T @ scaled @ self.basis, R * R.shape[0] / jnp.trace(R), W

    def loss(self, free: FreeCost, data: Demonstrations, windows: Int[Array, "b 2"]) -> tuple:
        """What is minimised, and the imitation loss and the prior in it."""
        Q, R, W = self.cost(free)

        def one(window: Int[Array, " 2"]) -> Array:
            done = data.window(window[0], window[1], self.recipe.horizon)
            problem = tracking_problem(done.A, done.B, done.offset, Q, R, done.goal)
            planned = lqr_trajectory(problem, done.states[0])
            states = jnp.sum(self.state_weight * (planned.states - done.states) ** 2)
            controls = jnp.sum(self.control_weight * (planned.controls - done.controls) ** 2)
            return states + controls

        imitation = jnp.mean(jax.vmap(one)(windows))
        tied = jnp.sum((W - independent_part(W, self.alike)) ** 2) / jnp.sum(W**2)
        even = jnp.sum((R - jnp.eye(R.shape[0])) ** 2) / R.shape[0]
        prior = tied + even
        return imitation + self.recipe.prior_weight * prior, (imitation, prior)


def cost_learner(
    data: Demonstrations, starts: np.ndarray, recipe: CostRecipe, alike: np.ndarray
) -> CostLearner:
    """A learner whose units are those of the data; ``starts`` [W, 2], ``alike`` as in `fit_cost`.

    Raises `InvalidInputError` where no window moves or no control acts.
    """
    D, H = alike.shape[0], recipe.horizon
    m = data.states.shape[-1]
    states = np.asarray(data.states, dtype=np.float64)
    run, begin = starts[:, 0], starts[:, 1]
    moved = (states[run, begin + H] - states[run, begin]).reshape(len(starts), -1, 2, D)
    force = _size(np.asarray(data.controls), "control")
    distance = _size(moved[:, :, 0], "position")
    speed = _size(states.reshape(*states.shape[:2], -1, 2, D)[:, :, :, 1], "velocity")
    scale = np.tile(np.repeat([distance, speed], D), m // (2 * D))
    weight = recipe.discount ** np.arange(H)
    weight = weight / weight.sum()
    dtype = data.states.dtype
    U = data.controls.shape[-1]
    return CostLearner(
        basis=jnp.asarray(relative_basis(m // (2 * D), D), dtype),
        units=jnp.asarray(force / scale, dtype),
        alike=jnp.asarray(alike, dtype),
        state_weight=jnp.asarray(np.append(0.0, weight)[:, None] / (m * scale**2), dtype),
        control_weight=jnp.asarray(np.tile(weight[:, None] / (U * force**2), (1, U)), dtype),
        recipe=recipe,
    )


def _size(values: np.ndarray, name: str) -> float:
    """Root mean square; raises where there is nothing."""
    size = float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
    if not size > 0.0:
        raise InvalidInputError(f"runs: {name} never changes from 0; nothing was demonstrated")
    return size


@eqx.filter_jit
def advance_learner(
    learner: CostLearner, data: Demonstrations, state: LearnerState, windows: Int[Array, "S b 2"]
) -> tuple[LearnerState, LearningHistory]:
    """As many steps of Adam as there are batches of windows."""
    optimiser = learner.optimiser()

    def step(state: LearnerState, batch: Array) -> tuple[LearnerState, LearningHistory]:
        gradient, (imitation, prior) = jax.grad(learner.loss, has_aux=True)(state.free, data, batch)
        change, inner = optimiser.update(gradient, state.optimiser)
        free = optax.apply_updates(state.free, change)
        Q, R, _ = learner.cost(free)
        q, r = jnp.linalg.eigvalsh(Q), jnp.linalg.eigvalsh(R)
        # Below zero by rounding alone is zero.
        rounded = jnp.where(q[0] > -ROUNDING * q[-1], jnp.maximum(q[0], 0.0), q[0])
        return LearnerState(free, inner), LearningHistory(imitation, prior, rounded, r[0])

    return jax.lax.scan(step, state, windows)
