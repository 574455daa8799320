"""System identification of the laws of touches: Gauss-Newton on recorded steps, before training.

The motion after an impact depends on its place and moment so steeply that gradients through it are
noise. A dozen numbers need none: differences of simulated steps tell them within seconds.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from contactgraph.bodies.graph import edge_count, first_where
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.data.windows import window_weights
from contactgraph.dynamics.contact_law import ContactLaw
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.batch import Window, window_source
from contactgraph.train.filter_loss import given_steps
from contactgraph.train.loss import chunked_vmap

_SPREADS = {
    "bounce_raw": 0.3,
    "friction_raw": 0.3,
    "log_inertia": 0.02,
}
"""Standard deviations of the numbers about their starts, in their own units: see `ContactLaw`. What
the data do not tell stays there. Outlines of uniform density tell the inertia within a tenth."""
_WINDOWS, _STEPS = 256, 2
"""Windows of the fit, and their steps: more would diverge from the recording after an impact."""
_ERROR = 0.03
"""Error of a step in units of the typical velocity, from which it counts less."""
_GUESSES, _IMPROVED, _DIFFERENCE, _MOST_EVALUATIONS = 64, 2, 0.1, 12
"""Draws of the prior; the best of them that are improved; step of the differences, in spreads; and
most evaluations of the residuals, without those."""


def identifies_laws(model: ContactDynamics) -> bool:
    """Whether `identify_laws` finds all that this model learns: see `ModelConfig.identified`."""
    head = getattr(model.local_dynamics, "head", None)
    return isinstance(head, ContactLaw) and head.identified


def identify_laws(model: ContactDynamics, batch: TrajectoryBatch[np.ndarray]) -> ContactDynamics:
    """The model with bounce, friction and inertia by the data.

    Maximum a posteriori: a normal prior about the model's own numbers, and a pseudo-Huber loss of
    the velocities in windows in which something happens; every near pair touches.
    """
    weights = window_weights(batch, _STEPS, 1.0)
    windows = window_source(batch, weights, False).draw(_WINDOWS, jax.random.key(0))
    leaves = {
        name: np.asarray(each, float) for name, each in zip(_SPREADS, _leaves(model), strict=True)
    }
    spread = np.concatenate([np.full(len(each), _SPREADS[name]) for name, each in leaves.items()])
    start = np.concatenate(list(leaves.values()))
    free = np.asarray(windows.learned)[:, None, :, None]
    typical = float(np.sqrt(np.mean(np.square(windows.velocity), where=free)))
    # Of bodies at rest, errors count from those on that a part of their weight would make.
    weight = model.dt * float(np.linalg.norm(np.asarray(windows.nodes.gravity)[0]))
    scale = _ERROR * max(typical, weight) * np.sqrt(_STEPS)

    def with_numbers(shift: np.ndarray) -> ContactDynamics:
        # About 1, because differences are relative.
        numbers = jnp.asarray(start + spread * (shift - 1.0), jnp.float32)
        ends = np.cumsum([len(each) for each in _leaves(model)])[:-1]
        return eqx.tree_at(_leaves, model, jnp.split(numbers, ends))

    def residuals(shift: np.ndarray) -> np.ndarray:
        each = np.asarray(_velocity_errors(with_numbers(shift), windows), float)
        each = each.reshape(_WINDOWS, -1) / scale
        size = np.maximum(np.linalg.norm(each, axis=1, keepdims=True), np.finfo(float).tiny)
        less = np.sqrt(2.0 * (np.sqrt(1.0 + size**2) - 1.0)) / size
        return np.concatenate([np.nan_to_num(each * less).ravel(), shift - 1.0])

    def improved(shift: np.ndarray) -> scipy.optimize.OptimizeResult:
        return scipy.optimize.least_squares(
            residuals, shift, diff_step=_DIFFERENCE, max_nfev=_MOST_EVALUATIONS
        )

    drawn = np.random.default_rng(0).normal(1.0, 1.0, (_GUESSES, len(start)))
    guesses = sorted([np.ones_like(start), *drawn], key=lambda shift: np.sum(residuals(shift) ** 2))
    found = [improved(each) for each in guesses[:_IMPROVED]]
    return with_numbers(min(found, key=lambda each: each.cost).x)


def _leaves(model: Any) -> list[Array]:
    return [getattr(model.local_dynamics.head, name) for name in _SPREADS]


@eqx.filter_jit
def _velocity_errors(model: ContactDynamics, windows: Window) -> Float[Array, "B L N G"]:
    """m/s; of the bodies that move freely."""
    edges = edge_count(None, windows.position.shape[-2])

    def errors(window: Window) -> Float[Array, "L N G"]:
        types = model.inference.edge_types
        touch = jax.nn.one_hot(first_where(each.unilateral for each in types), 1 + len(types))
        touching = jnp.broadcast_to(touch, (_STEPS, edges, len(touch)))
        _, velocity, _ = given_steps(model, window, touching, touching, jnp.asarray(True))
        return jnp.where(window.learned[:, None], velocity - window.velocity[1:], 0.0)

    return chunked_vmap(errors, (windows,), edges)
