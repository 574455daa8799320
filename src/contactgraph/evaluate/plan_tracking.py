"""Plan tracking: planned against executed positions."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from contactgraph.control import PlanStatus
from contactgraph.data import Trajectory, moving_bodies, pair_indices
from contactgraph.evaluate.baselines import constant_velocity, fixed_contact_oracle
from contactgraph.evaluate.edge_scores import EdgeCounts, edge_counts
from contactgraph.evaluate.statistics import Sums, finite_or_none, number_or_word
from contactgraph.policies import EpisodeRecord

_HORIZON_S = 0.5


@dataclass(frozen=True)
class SquaredError(Sums):
    """A sum of squared distances, m^2, and their number; those of several episodes add up."""

    total: float = 0.0
    count: int = 0

    @property
    def rmse(self) -> float | None:
        """m. None without any distance; infinite where one is not finite."""
        return math.sqrt(self.total / self.count) if self.count else None


@dataclass(frozen=True)
class PlanTrackingError(Sums):
    """The paper's N-step error of executed plans; those of several episodes add up.

    A window begins with every plan that was made from an observation and then followed by its
    feedback, without another plan, for ``n_steps`` steps, 0.5 s. None: unknown in an episode.
    A controller that moves no object has no error.
    """

    windows: int = 0
    moved_objects: int = 0
    """Nodes without actuation that get more than 1 mm away from their first position in a window,
    added up over the windows."""
    planned_moving: SquaredError = field(default_factory=SquaredError)
    """Planned against executed positions of the nodes that move as far, over windows and steps."""
    planned: SquaredError = field(default_factory=SquaredError)
    """The same for all nodes."""
    constant_velocity: SquaredError = field(default_factory=SquaredError)
    """Baseline without forces, from the windows' first states: see `constant_velocity`."""
    fixed_contact: SquaredError | None = field(default_factory=SquaredError)
    """Oracle with true masses and the windows' first contacts, under the executed controls."""
    edges: EdgeCounts | None = field(default_factory=EdgeCounts)
    """Planned beliefs, above 1/2 or not, against executed contacts."""
    by_episode: tuple[float | None, ...] = ()
    """m: `rmse_moving` of each episode."""

    @property
    def rmse_moving(self) -> float | None:
        """m, of the nodes that move. None where no object does: resting ones are easy to plan."""
        return self.planned_moving.rmse if self.moved_objects else None

    @property
    def rmse(self) -> float | None:
        """m, of all nodes. None as `rmse_moving`."""
        return self.planned.rmse if self.moved_objects else None

    def to_json(self) -> dict[str, float | int | list[float | str | None] | None]:
        """All numbers by name; None for those that are not known or not finite; in the list
        ``infinite`` for the latter."""
        numbers = {
            "n_step_rmse_planned_moving_m": self.rmse_moving,
            "n_step_rmse_planned_m": self.rmse,
            "constant_velocity_planned_rmse_m": self.constant_velocity.rmse,
            "frozen_contact_planned_rmse_m": getattr(self.fixed_contact, "rmse", None),
            **{
                f"edge_{score}_planned": getattr(self.edges, score, None)
                for score in ("precision", "recall", "f1", "accuracy")
            },
        }
        return {
            "planned_windows": self.windows,
            "planned_moved_objects": self.moved_objects,
            **{name: finite_or_none(value) for name, value in numbers.items()},
            "n_step_rmse_planned_moving_by_episode_m": list(map(number_or_word, self.by_episode))
            or None,
        }


def plan_tracking_error(trajectory: Trajectory, record: EpisodeRecord) -> PlanTrackingError:
    """Compares the plans of one episode with the executed motion.

    Plans shorter than 0.5 s, and those replaced before that, are not compared: with a new plan
    every ``P`` steps there is a window only where ``P dt`` is 0.5 s or more.
    """
    steps = max(1, round(_HORIZON_S / trajectory.scene.dt))
    horizon = record.plan.shape[1] - 1
    starts = _followed(record.status, steps) if steps <= horizon else np.zeros(0, dtype=int)
    if not len(starts):
        known = trajectory.contact is not None
        return PlanTrackingError(
            fixed_contact=SquaredError() if known else None,
            edges=EdgeCounts() if known else None,
            by_episode=(None,),
        )
    ahead = starts[:, None] + np.arange(1, steps + 1)
    executed = trajectory.position[ahead]
    moves = moving_bodies(trajectory.position[starts[:, None] + np.arange(steps + 1)])

    def error(predicted: np.ndarray, chosen: np.ndarray) -> SquaredError:
        """``predicted``: [W, H, N, D] m. ``chosen``: [W, N] bool."""
        squared = np.sum((predicted - executed) ** 2, axis=-1)
        squared = np.where(np.isfinite(squared), squared, np.inf)
        count = int(chosen.sum()) * steps
        return SquaredError(float(np.sum(squared.sum(axis=1), where=chosen)), count)

    planned = record.plan[starts, 1 : steps + 1]
    every = np.ones(moves.shape, dtype=bool)
    oracle = fixed_contact_oracle(trajectory, steps)
    found = PlanTrackingError(
        windows=len(starts),
        moved_objects=int(moves[:, ~trajectory.scene.actuated].sum()),
        planned_moving=error(planned, moves),
        planned=error(planned, every),
        constant_velocity=error(constant_velocity(trajectory, steps)[starts], every),
        fixed_contact=None if oracle is None else error(oracle[starts], every),
        edges=_edges(trajectory, record.plan_belief[starts, :steps], ahead),
    )
    return replace(found, by_episode=(found.rmse_moving,))


def _followed(status: np.ndarray, steps: int) -> np.ndarray:
    """[W] control steps whose new plan was followed for ``steps`` steps, its own included."""
    made = np.isin(status, [each for each in PlanStatus if each.solved])
    followed = status == PlanStatus.PLAN_REUSED
    planned = np.flatnonzero(made[: max(0, len(status) - steps + 1)])
    return np.array([t for t in planned if followed[t + 1 : t + steps].all()], dtype=int)


def _edges(trajectory: Trajectory, belief: np.ndarray, ahead: np.ndarray) -> EdgeCounts | None:
    """``belief``: [W, H, E], about the steps that lead to the states ``ahead`` [W, H]."""
    if trajectory.contact is None:
        return None
    first, second = pair_indices(trajectory.scene.node_count).T
    exists = np.ones((len(belief), len(first)), dtype=bool)
    return edge_counts(belief > 0.5, trajectory.contact[ahead][:, :, first, second], exists)
