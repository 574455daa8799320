"""The held-out error, by which the best model is chosen, beside baselines on the same windows.

Bodies that rest within a window are predicted exactly by a model that has learned nothing, and so
would dilute a mean. The error is therefore over the bodies that move.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from contactgraph.data.windows import moving_bodies
from contactgraph.model.contact_belief import ContactBelief
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.motion_likelihood import TrajectoryModel
from contactgraph.model.neighbor_list import edge_count
from contactgraph.train.batch import Window, WindowSource
from contactgraph.train.filter_loss import corrected_beliefs
from contactgraph.train.loss import chunked_vmap, predict_window

_WINDOWS = 256


@dataclass(frozen=True)
class HeldOutBaselines:
    """Errors without a model, on the same windows and over the same bodies as the held-out error.

    A model is of use only where its error is less than both.
    """

    constant_velocity_rmse_m: float
    """Every body keeps the velocity of the window's first state."""
    standing_still_rmse_m: float
    """Every body keeps the position of the window's first state."""
    moving: bool
    """Whether the errors are over the bodies that move; False where no body does: over all."""


class HeldOutWindows(eqx.Module):
    """A fixed set of ``B`` windows of held-out trajectories, and the bodies that count in them."""

    windows: Window
    counted: Bool[Array, "B N"]
    moving: bool = eqx.field(static=True)
    """Whether the bodies that move are counted; else all are, because none moves."""
    before: Window | None = None
    """The steps before each window, whose motion corrects the belief in its first state. None: the
    first state is the first that is known."""

    def baselines(self, dt: float) -> HeldOutBaselines:
        """The errors of constant velocity and of standing still; steps of ``dt`` [s]."""
        position = np.asarray(self.windows.position, float)
        velocity = np.asarray(self.windows.velocity, float)
        elapsed = dt * np.arange(1, position.shape[1])[:, None, None]

        def rmse(predicted: np.ndarray) -> float:
            squared = jnp.asarray(np.sum((predicted - position[:, 1:]) ** 2, axis=-1), float)
            return float(mean_rmse(squared, self.counted))

        first = position[:, :1]
        return HeldOutBaselines(rmse(first + elapsed * velocity[:, :1]), rmse(first), self.moving)


def held_out_windows(source: WindowSource, burn: int = 0) -> HeldOutWindows:
    """Windows balanced over events as those of training are, the same in every training.

    Of each window that ``source`` draws, the first ``burn`` steps only correct the belief. Bodies
    that get more than `MOVES_M` away from their first position in a window are counted, static ones
    and padding are not. Where no body moves in any window, all are.
    """
    drawn = source.draw(_WINDOWS, jax.random.key(0))
    windows = drawn.part(burn, drawn.control.shape[1])
    exists = np.asarray(windows.learned)
    moves = exists & moving_bodies(np.asarray(windows.position))
    moving = bool(moves.any())
    counted = jnp.asarray(moves if moving else exists)
    return HeldOutWindows(windows, counted, moving, drawn.part(0, burn) if burn else None)


def mean_rmse(squared: Float[Array, "B L N"], counted: Bool[Array, "B N"]) -> Float[Array, ""]:
    """Mean over windows of the RMS over steps and counted bodies; windows without one are left out.

    The mean is over roots, so that one grazing contact predicted wrongly does not determine which
    model is best.
    """
    bodies = jnp.sum(counted, axis=1)
    total = jnp.sum(jnp.where(counted[:, None], squared, 0.0), axis=(1, 2))
    root = jnp.sqrt(total / (squared.shape[1] * jnp.maximum(bodies, 1)))
    return jnp.sum(root) / jnp.maximum(jnp.sum(bodies > 0), 1)


def rollout_rmse(model: ContactDynamics, held_out: HeldOutWindows) -> Float[Array, ""]:
    """`mean_rmse` of the positions [m] of windows that are predicted from their first states."""

    def squared_error(window: Window, belief: ContactBelief | None) -> Float[Array, "L N"]:
        states = predict_window(model, window, belief)
        return jnp.sum((states.position - window.position[1:]) ** 2, axis=-1)

    windows, before = held_out.windows, held_out.before
    if before is None:
        belief = None
    elif isinstance(model, TrajectoryModel):
        real = jnp.ones(before.control.shape[:2], bool)
        belief = jax.vmap(model.trajectory_belief)(before.trajectories(real))
    else:
        belief = corrected_beliefs(model, before)
    edges = edge_count(model.neighbor_list, windows.position.shape[-2])
    return mean_rmse(chunked_vmap(squared_error, (windows, belief), edges), held_out.counted)
