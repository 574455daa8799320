"""Planned against executed: where plans put the nodes, and where following them led."""

import math
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from contactgraph.control import PlanStatus
from contactgraph.data import Trajectory, pair_indices
from contactgraph.evaluate.control_policy import EpisodeRecord
from contactgraph.evaluate.edge_scores import EdgeCounts, edge_counts
from contactgraph.evaluate.floors import constant_velocity, frozen_contact

_MOVES_M = 1e-3
_HORIZON_S = 0.5


@dataclass(frozen=True)
class SquaredError:
    """A sum of squared distances, m^2, and over how many; sums of several runs add up."""

    total: float = 0.0
    count: int = 0

    def __add__(self, other: "SquaredError") -> "SquaredError":
        return SquaredError(self.total + other.total, self.count + other.count)

    @property
    def rmse(self) -> float | None:
        """m. None where there is nothing to average; infinite where one is not finite."""
        return math.sqrt(self.total / self.count) if self.count else None


_Counts = TypeVar("_Counts", SquaredError, EdgeCounts)


@dataclass(frozen=True)
class PlannedError:
    """The paper's N-step error, on the plans that were executed; those of episodes add up.

    A window begins with every plan that was made for what was observed and then followed by its
    feedback, without another plan, for ``n_steps`` steps, 0.5 s. None: unknown in an episode.
    """

    windows: int = 0
    planned: SquaredError = field(default_factory=SquaredError)
    """Planned against executed positions, over windows, steps and nodes."""
    planned_moving: SquaredError = field(default_factory=SquaredError)
    """The same, of nodes that get more than 1 mm away from where they were."""
    constant_velocity: SquaredError = field(default_factory=SquaredError)
    """Of no forces, from the windows' first states: see `constant_velocity`."""
    frozen_contact: SquaredError | None = field(default_factory=SquaredError)
    """Of true masses and the windows' first contacts, with the controls that were executed."""
    edges: EdgeCounts | None = field(default_factory=EdgeCounts)
    """Planned beliefs, above 1/2 or not, against executed contacts."""

    def __add__(self, other: "PlannedError") -> "PlannedError":
        return PlannedError(
            windows=self.windows + other.windows,
            planned=self.planned + other.planned,
            planned_moving=self.planned_moving + other.planned_moving,
            constant_velocity=self.constant_velocity + other.constant_velocity,
            frozen_contact=_sum(self.frozen_contact, other.frozen_contact),
            edges=_sum(self.edges, other.edges),
        )

    def to_json(self) -> dict[str, float | int | None]:
        """All numbers by name; None for those that are not known or not finite."""
        frozen, edges = self.frozen_contact, self.edges
        numbers = {
            "n_step_rmse_planned_m": self.planned.rmse,
            "n_step_rmse_planned_moving_m": self.planned_moving.rmse,
            "constant_velocity_planned_rmse_m": self.constant_velocity.rmse,
            "frozen_contact_planned_rmse_m": None if frozen is None else frozen.rmse,
            "edge_precision_planned": None if edges is None else edges.precision,
            "edge_recall_planned": None if edges is None else edges.recall,
            "edge_f1_planned": None if edges is None else edges.f1,
            "edge_accuracy_planned": None if edges is None else edges.accuracy,
        }
        return {
            "planned_windows": self.windows,
            **{
                name: value if value is not None and math.isfinite(value) else None
                for name, value in numbers.items()
            },
        }


def planned_error(run: Trajectory, record: EpisodeRecord) -> PlannedError:
    """Compares the plans of one episode with what came of them.

    Plans shorter than 0.5 s, and those replaced before that, are not compared: with a new plan
    every ``P`` steps there is a window only where ``P dt`` is 0.5 s or more.
    """
    steps = max(1, round(_HORIZON_S / run.scene.dt))
    horizon = record.plan.shape[1] - 1
    starts = _followed(record.status, steps) if steps <= horizon else np.zeros(0, dtype=int)
    if not len(starts):
        known = run.contact is not None
        return PlannedError(
            frozen_contact=SquaredError() if known else None, edges=EdgeCounts() if known else None
        )
    ahead = starts[:, None] + np.arange(1, steps + 1)
    executed = run.position[ahead]
    travel = np.linalg.norm(executed - run.position[starts, None], axis=-1).max(axis=1)

    def error(predicted: np.ndarray, chosen: np.ndarray) -> SquaredError:
        """``predicted``: [W, H, N, D] m. ``chosen``: [W, N] bool."""
        squared = np.sum((predicted - executed) ** 2, axis=-1)
        squared = np.where(np.isfinite(squared), squared, np.inf)
        count = int(chosen.sum()) * steps
        return SquaredError(float(np.sum(squared.sum(axis=1), where=chosen)), count)

    planned = record.plan[starts, 1 : steps + 1]
    every = np.ones(travel.shape, dtype=bool)
    frozen = frozen_contact(run, steps)
    return PlannedError(
        windows=len(starts),
        planned=error(planned, every),
        planned_moving=error(planned, travel > _MOVES_M),
        constant_velocity=error(constant_velocity(run, steps)[starts], every),
        frozen_contact=None if frozen is None else error(frozen[starts], every),
        edges=_edges(run, record.plan_belief[starts, :steps], ahead),
    )


def _sum(one: _Counts | None, other: _Counts | None) -> _Counts | None:
    """Known where both are."""
    return None if one is None or other is None else one + other


def _followed(status: np.ndarray, steps: int) -> np.ndarray:
    """[W] the ticks whose plan was made then and followed for ``steps`` steps, its own included."""
    made = np.isin(status, [each for each in PlanStatus if each.solved])
    followed = status == PlanStatus.FOLLOWED
    ticks = np.flatnonzero(made[: max(0, len(status) - steps + 1)])
    return np.array([t for t in ticks if followed[t + 1 : t + steps].all()], dtype=int)


def _edges(run: Trajectory, belief: np.ndarray, ahead: np.ndarray) -> EdgeCounts | None:
    """``belief``: [W, H, E], about the steps that lead to the states ``ahead`` [W, H]."""
    if run.contact is None:
        return None
    first, second = pair_indices(run.scene.node_count).T
    exists = np.ones((len(belief), len(first)), dtype=bool)
    return edge_counts(belief > 0.5, run.contact[ahead][:, :, first, second], exists)
