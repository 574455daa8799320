"""A learned cost in numbers a person can judge: what it costs to be off, in newtons."""

from dataclasses import dataclass

import numpy as np

from contactgraph.control.learned_cost import LearnedCost
from contactgraph.control.relative_form import relative_names, relative_terms


@dataclass(frozen=True)
class CostTerm:
    """One of the relative terms of a cost, or its goal term, against what force costs.

    With ``W`` the term's block of `relative_terms`, ``position = sqrt(mean diag W_pp / mean diag
    R)``, means over axes; ``velocity`` the same of ``W_vv``. A factor on Q and R changes neither.
    """

    name: str
    """E.g. ``"gripper - target"``."""
    position: float
    """N/m: a metre off for one step costs as much as this force in it."""
    velocity: float
    """N s/m: 1 m/s off for one step costs as much as this force in it."""


def cost_terms(cost: LearnedCost) -> tuple[CostTerm, ...]:
    """The terms of a cost in the order of its kept nodes; the last one is about the goal."""
    D = cost.goal.shape[0]
    weights = np.diagonal(relative_terms(np.asarray(cost.Q), D)).reshape(-1, 2, D)
    of_force = float(np.mean(np.diagonal(np.asarray(cost.R, dtype=np.float64))))
    # Below zero by rounding alone is zero.
    sizes = np.sqrt(np.maximum(weights.mean(axis=2), 0.0) / of_force)
    return tuple(
        CostTerm(name, float(position), float(velocity))
        for name, (position, velocity) in zip(relative_names(cost.kept_nodes), sizes, strict=True)
    )
