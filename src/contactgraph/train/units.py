"""Units of training, so that those of the data do not matter; the trained model in the data's."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.data.dataset import Dataset
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.scene import Scene
from contactgraph.data.trajectory import Trajectory
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.features import InvariantFeatures
from contactgraph.model.motion_noise import in_lengths


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


def typical_distance(dataset: Dataset) -> float:
    """Median distance of two bodies over all pairs and states, m: the unit of force laws."""
    found = []
    for each in dataset:
        first, second = np.triu_indices(each.scene.node_count, 1)
        apart = each.position[:, first] - each.position[:, second]
        found.append(np.linalg.norm(apart, axis=-1).ravel())
    distance = np.concatenate(found)
    return float(np.median(distance)) if distance.size else 1.0


def in_units(dataset: Dataset, units: Units) -> Dataset:
    """The same trajectories, in these units."""
    every = tuple(_trajectory(each, units) for each in dataset)
    return dataclasses.replace(dataset, trajectories=every)


def in_data_units(model: ContactDynamics, fresh: ContactDynamics, units: Units) -> ContactDynamics:
    """The trained preset `bodies`, for states and controls in the data's units.

    ``fresh`` is the preset made for the data's units. What is not learned, such as the actuation,
    is taken from it.
    """
    inference, noise, other = model.inference, model.prediction_noise, fresh.prediction_noise
    arrays, static = eqx.partition(fresh, eqx.is_array)
    own = jax.tree.leaves(eqx.filter(model, eqx.is_array))
    learned = eqx.combine(jax.tree.unflatten(jax.tree.structure(arrays), own), static)

    def given(each: Any) -> tuple[Any, ...]:
        return each.local_dynamics.head.actuation, each.local_dynamics.head.plane_distance

    moved = eqx.tree_at(given, learned, given(fresh))
    if noise is None or other is None:
        return moved

    def by_unit(each: Any) -> tuple[Any, ...]:
        return each.inference.message_passing.network.layers[0].weight, each.prediction_noise

    weight, _ = by_unit(moved)
    begin = model.features.edge_size(model.dimension) + 1
    unit = jnp.asarray(units.control[len(units.control) - inference.commands :], weight.dtype)
    weight = weight.at[:, begin : begin + inference.commands].divide(unit)
    moved = eqx.tree_at(by_unit, moved, (weight, in_lengths(noise, units.length, other)))
    if not isinstance(model.features, InvariantFeatures) or not model.features.learned:
        return moved
    distance = units.length * model.features.contact_distance
    return eqx.tree_at(lambda each: each.features.contact_distance, moved, distance)


def _trajectory(each: Trajectory, units: Units) -> Trajectory:
    lengths: dict[str, Any] = {
        name: None if getattr(each, name) is None else getattr(each, name) / units.length
        for name in ("position", "velocity", "link_positions")
    }
    control = each.control / np.array(units.control)
    scene = _scene(each.scene, units.length)
    return dataclasses.replace(each, scene=scene, control=control, **lengths)


def _scene(scene: Scene, length: float) -> Scene:
    given: dict[str, Any] = {
        name: getattr(scene, name) / length
        for name in ("anchor", "goal", "gravity", "radius", "size", "reach", "pin_points")
        if getattr(scene, name) is not None
    }
    if scene.planes is not None:
        given["planes"] = scene.planes / np.append(np.ones(scene.dimension), length)
    if scene.polygons is not None:
        given["polygons"] = tuple(each / length for each in scene.polygons)
    metadata = dict(scene.metadata)
    distance = metadata.get("contact_distance")
    if isinstance(distance, int | float):
        metadata["contact_distance"] = distance / length
    return dataclasses.replace(scene, metadata=metadata, **given)
