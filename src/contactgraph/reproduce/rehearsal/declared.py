"""What the rehearsal of the paper's real experiment measures, and how much of it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class RehearsalAmounts:
    """How much of everything."""

    training_runs: int
    validation_runs: int
    seconds: float
    """Of each recorded run."""
    episodes: int
    """Of control, for each way of knowing contacts."""
    pace: float
    """Wall seconds to a simulated one: what two cores hold with server, camera and planner."""
    training_options: tuple[str, ...] = ()


EVERY = 10
"""Recorded steps of 0.001 s to a step of the model."""
TRAINING_SEED, VALIDATION_SEED, CONTROL_SEED = 10, 11, 12
"""Nothing was tuned on the runs and scenes of these seeds."""
TRAINED_SEED = 0
"""Of the weights."""

FULL_REHEARSAL = RehearsalAmounts(25, 5, 10.0, 20, 4.0)
QUICK_REHEARSAL = RehearsalAmounts(4, 1, 5.0, 1, 4.0, ("--steps", "600"))


@dataclass(frozen=True)
class Knowing:
    """How a controller knows of contacts."""

    slug: str
    """Names files."""
    name: str
    options: tuple[str, ...]
    """Of ``rehearse-control``."""


BY_FINGERS = Knowing("fingers", "by the fingers' width", ())
BY_MOTION = Knowing("motion", "by the fingers' width, and by motion", ("--infer-contacts",))
WAYS = (BY_FINGERS, BY_MOTION)
