"""The state of a training, its progress, and its result with a status."""

import enum
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.bodies.graph import EdgeList
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.held_out import HeldOutBaselines

_TIE = 1e-3
"""Relative difference of errors up to which neither is better."""


class FitStatus(enum.Enum):
    """The end of training; the value is the text for users."""

    finished = "all steps done"
    stopped_early = "the held-out error no longer fell"
    not_finite = "the loss became infinite or not a number; a lower learning rate may help"
    dead_units = "the network is dead: its messages are the same for every pair of bodies"
    constant_velocity = "the network is dead: its error equals that of constant velocity"


class FitState(eqx.Module):
    """All that training carries from step to step.

    Training continues bit for bit from a saved and restored state.
    """

    model: ContactDynamics
    optimiser: optax.OptState
    key: PRNGKeyArray
    step: Int[Array, ""]
    best_model: ContactDynamics
    best_error: Float[Array, ""]
    """m; held-out error of `best_model`, see `rollout_rmse`."""
    checks_without_gain: Int[Array, ""]

    def __repr__(self) -> str:
        return f"FitState(step {self.step}, best_error {self.best_error} m, {self.model!r})"


def with_lists(state: FitState, lists: EdgeList | None) -> FitState:
    """The state with these lists in the models, and in the averages that mirror them."""

    def is_model(part: object) -> bool:
        return isinstance(part, ContactDynamics)

    return jax.tree.map(
        lambda part: replace(part, neighbor_list=lists) if is_model(part) else part,
        state,
        is_leaf=is_model,
    )


@dataclass(frozen=True)
class FitProgress:
    """The state of training at one check."""

    step: int
    steps: int
    terms: dict[str, float]
    """Loss terms by name, means since the last check."""
    held_out_rmse_m: float
    """Position error of the bodies that move, over windows of held-out trajectories that are
    predicted from their first states, at this check."""
    seconds: float
    """Since this call of `fit` began, compilation included."""
    state: FitState
    baselines: HeldOutBaselines


@dataclass(frozen=True)
class FitResult:
    """The model with the least error on the held-out trajectories."""

    model: ContactDynamics
    held_out_rmse_m: float
    status: FitStatus
    state: FitState
    seconds: float
    """Of this call of `fit`, compilation included."""
    baselines: HeldOutBaselines

    def __repr__(self) -> str:
        baseline = f"constant velocity {self.baselines.constant_velocity_rmse_m:.4g} m"
        error = f"held-out error {self.held_out_rmse_m:.4g} m, {baseline}"
        return f"FitResult({self.status.value}, {error}, {self.seconds:.0f} s)"

    @property
    def is_better(self) -> bool:
        """Whether the model predicts better than constant velocity and than standing still.

        Errors that differ by less than 0.1 % are equal.
        """
        baselines = self.baselines
        least = min(baselines.constant_velocity_rmse_m, baselines.standing_still_rmse_m)
        return self.held_out_rmse_m < (1.0 - _TIE) * least
