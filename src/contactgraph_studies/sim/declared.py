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
    training_options: tuple[str, ...]


EVERY = 10
"""Recorded steps of 0.001 s to a step of the model."""
TRAINING_SEED, VALIDATION_SEED, CONTROL_SEED = 20, 31, 22
"""Nothing was tuned on the runs and scenes of these seeds."""
IN_PASSING = ("--stopping", "0")
"""Validation runs are the paper's dynamic pickups, and tours without any. Some of the training runs
grasp at rest, so that blocks are held here and there in the hand."""
TRAINED_SEED = 0
"""Of the weights."""

_FEW_IMPACTS = ("--event-fraction", "0.1")
"""A run of ten seconds has one impact or two, with strikes on corners and slips that no model of
points explains. With 60 % of the windows around them, as where runs are short, a free hand's mass
is learned badly: errors of 2.5 cm instead of 0.3 over half a second, on held-out training runs."""
FULL_REHEARSAL = RehearsalAmounts(25, 5, 10.0, 20, 4.0, _FEW_IMPACTS)
QUICK_REHEARSAL = RehearsalAmounts(4, 1, 5.0, 1, 4.0, (*_FEW_IMPACTS, "--steps", "600"))


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
