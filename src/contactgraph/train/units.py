"""Units of training, so that those of the data do not matter; the trained model in the data's."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.data.dataset import Dataset
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.scene import Scene
from contactgraph.data.schema import changed
from contactgraph.data.trajectory import Trajectory
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.edge_inference import TransitionEdges
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
    return dataset.map(lambda each: _trajectory(each, units))


def in_data_units(model: ContactDynamics, fresh: ContactDynamics, units: Units) -> ContactDynamics:
    """The trained preset `bodies`, for states and controls in the data's units.

    ``fresh`` is the preset made for the data's units. What is not learned, such as the actuation,
    is taken from it.
    """
    inference, noise, other = model.inference, model.prediction_noise, fresh.prediction_noise
    arrays, static = eqx.partition(fresh, eqx.is_array)
    own = jax.tree.leaves(eqx.filter(model, eqx.is_array))
    learned = eqx.combine(jax.tree.unflatten(jax.tree.structure(arrays), own), static)
    if not isinstance(inference, TransitionEdges):

        def laid(each: Any) -> tuple[Any, ...]:
            return each.local_dynamics.head.actuation, each.local_dynamics.head.plane_distance

        return eqx.tree_at(laid, learned, laid(fresh))
    assert noise is not None and other is not None
    first = inference.message_passing.network.layers[0].weight
    begin = model.features.edge_size(model.dimension) + 1
    commands = slice(begin, begin + inference.commands)
    unit = jnp.asarray(units.control[len(units.control) - inference.commands :], first.dtype)

    def parts(each: Any) -> tuple[Any, ...]:
        head, passing = each.local_dynamics.head, each.inference.message_passing
        weight = passing.network.layers[0].weight
        return head.actuation, head.plane_distance, weight, each.prediction_noise

    actuation, plane_distance, _, _ = parts(fresh)
    by_command = first.at[:, commands].divide(unit)
    in_data = in_lengths(noise, units.length, other)
    moved = eqx.tree_at(parts, learned, (actuation, plane_distance, by_command, in_data))
    if not isinstance(model.features, InvariantFeatures) or not model.features.learned:
        return moved
    distance = units.length * model.features.contact_distance
    return eqx.tree_at(lambda each: each.features.contact_distance, moved, distance)


def _trajectory(each: Trajectory, units: Units) -> Trajectory:
    return changed(
        each,
        lambda field, value: value / units.length if field.of_length else value,
        control=each.control / np.array(units.control),
        scene=_scene(each.scene, units.length),
    )


def _scene(scene: Scene, length: float) -> Scene:
    planes, metadata = scene.planes, dict(scene.metadata)
    if planes is not None:
        planes = planes / np.append(np.ones(scene.dimension), length)
    distance = metadata.get("contact_distance")
    if isinstance(distance, int | float):
        metadata["contact_distance"] = distance / length
    return changed(
        scene,
        lambda field, value: value / length if field.of_length else value,
        planes=planes,
        metadata=metadata,
    )
