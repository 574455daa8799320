"""Units of training, so that those of the data do not matter."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data.dataset import Dataset
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.scene import Scene
from contactgraph.data.schema import changed
from contactgraph.data.trajectory import Trajectory


@dataclass(frozen=True)
class Units:
    """What 1 of a model's length and of each component of its control is in the data.

    Time is in seconds. Raises `InvalidInputError` where one is not a positive number.
    """

    length: float = 1.0
    control: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for each in (self.length, *self.control):
            if not (np.isfinite(each) and each > 0.0):
                raise InvalidInputError(f"units must be positive numbers, found {each}")


def units_of(dataset: Dataset, contact_distance: float, usual: float) -> Units:
    """Units in which bodies touch at about ``usual``, and the mean square of a control is 1.

    The length is a power of 1000: 1 for metres, 1000 for millimetres.
    """
    control = np.concatenate([each.control for each in dataset])
    spread = np.sqrt(np.mean(control**2, axis=0)) if len(control) else np.ones(0)
    length = 1000.0 ** np.round(np.log10(contact_distance / usual) / 3.0)
    return Units(float(length), tuple(float(each) or 1.0 for each in spread))


def in_units(dataset: Dataset, units: Units) -> Dataset:
    """The same trajectories, in these units."""
    return dataset.map(lambda each: _trajectory(each, units))


def _trajectory(each: Trajectory, units: Units) -> Trajectory:
    return changed(
        each,
        lambda field, value: value / units.length if field.of_length else value,
        control=each.control / np.array(units.control),
        scene=_scene(each.scene, units.length),
    )


def _scene(scene: Scene, length: float) -> Scene:
    metadata = dict(scene.metadata)
    distance = metadata.get("contact_distance")
    if isinstance(distance, int | float):
        metadata["contact_distance"] = distance / length
    return changed(
        scene,
        lambda field, value: value / length if field.of_length else value,
        planes=scene.planes / np.append(np.ones(scene.dimension), length),
        metadata=metadata,
    )
