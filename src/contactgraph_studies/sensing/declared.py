"""What the study of contact without a sensor measures: conditions, sensors, how much."""

from dataclasses import dataclass

from contactgraph_studies.declared import DOOR, FRANKA, MULTI_PICKUP, PICKUP, Options


@dataclass(frozen=True)
class Sensor:
    """What a controller is told of contacts."""

    slug: str
    """Names files."""
    name: str
    options: Options
    """Of ``control``."""


@dataclass(frozen=True)
class Condition:
    """What is not as in training."""

    slug: str
    name: str
    options: Options


@dataclass(frozen=True)
class SensingTask:
    """A task, with the model of the same name that comes with the package."""

    name: str
    conditions: tuple[Condition, ...]
    replan_every: int
    """Half a second, so that plans can be compared with what came of them; 1 step where a task is
    not done that way."""


@dataclass(frozen=True)
class SensingAmounts:
    """How much of everything."""

    seeds: tuple[int, ...]
    """Of scenes, above `SCENE_SEED`."""
    episodes: int
    """A seed, condition and sensor."""


SCENE_SEED = 1200
"""No other study and no model has seen these scenes, and nothing was tuned on them."""

MEASURED = Sensor("measured", "contacts measured", ())
UNMEASURED = Sensor("unmeasured", "nothing", ("--unmeasured",))
INFERRED = Sensor("inferred", "motion", ("--unmeasured", "--infer-contacts"))
MISSING = Sensor("missing", "a sensor with 30 % misses", ("--misses", "0.3"))
BOTH = Sensor("both", "that sensor and motion", ("--misses", "0.3", "--infer-contacts"))
SENSORS = (MEASURED, UNMEASURED, INFERRED, MISSING, BOTH)

_CAMERA = ("--position-noise", "0.001", "--velocity-noise", "0.02")
_WIDER = ("--radius", "0.042")
AS_TRAINED = Condition("as-trained", "as trained", ())
CAMERA = Condition("camera", "seen by a camera (1 mm, 2 cm/s)", _CAMERA)
WIDER = Condition("wider", "bodies 5 % wider than the model knows", _WIDER)
BOTH_OFF = Condition("wider-camera", "wider, and seen by a camera", (*_WIDER, *_CAMERA))
"""A model that knows where bodies touch needs no sensor: it sees that they do. A sensor can matter
where it does not know, and 2 mm of radius are what anybody's objects may well be off by."""

PICKUP_SENSING = SensingTask(PICKUP.name, (WIDER, AS_TRAINED, CAMERA, BOTH_OFF), 10)
SENSING_TASKS = (
    PICKUP_SENSING,
    SensingTask(MULTI_PICKUP.name, (CAMERA,), 10),
    SensingTask(DOOR.name, (CAMERA,), 10),
    SensingTask(FRANKA.name, (CAMERA,), 1),
)

FULL_SENSING = SensingAmounts((0, 1, 2), 20)
QUICK_SENSING = SensingAmounts((0,), 3)


def sensors_of(condition: Condition) -> tuple[Sensor, ...]:
    """A faulty sensor is tried where a sensor matters."""
    return SENSORS if condition is WIDER else SENSORS[:3]
