"""What runs say themselves about the model and the training that suit them."""

import math
from dataclasses import dataclass

from contactgraph.data.dataset import Dataset
from contactgraph.data.errors import InvalidInputError

_CONTACT_DISTANCE = 0.085
_TOLD = "contact_distance"


@dataclass(frozen=True)
class Suited:
    """Arguments of the presets and of `Recipe`, where the user has no other wish."""

    contact_distance: float
    """m; the one that the scenes' metadata tell, or 0.085."""
    learned_touch: bool
    """Not where it is told: who tells it may have fingers, which close when they like."""
    hinges: bool
    weight: bool
    rollout_from: float
    """0 where bodies have weight: one step does not tell the mass of what is carried from a spring
    that holds it, many do. Else 0.5, which is faster."""


def suited_to(dataset: Dataset) -> Suited:
    """Raises `InvalidInputError` where scenes tell several contact distances, or no distance."""
    told = {run.scene.metadata.get(_TOLD) for run in dataset}
    if len(told) > 1:
        raise InvalidInputError(f"{_TOLD} must be the same in all runs' metadata, found {told}")
    distance = told.pop()
    if distance is not None and not (
        isinstance(distance, int | float) and math.isfinite(distance) and distance > 0
    ):
        raise InvalidInputError(f"{_TOLD} must be positive metres, found {distance!r}")
    weight = any(run.scene.has_weight for run in dataset)
    return Suited(
        contact_distance=_CONTACT_DISTANCE if distance is None else float(distance),
        learned_touch=distance is None,
        hinges=any(run.scene.has_hinges for run in dataset),
        weight=weight,
        rollout_from=0.0 if weight else 0.5,
    )
