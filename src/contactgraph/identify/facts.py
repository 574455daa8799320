"""Facts that recordings tell before training, and the configuration that follows from them."""

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.bodies.graph import HOLD
from contactgraph.data.dataset import Dataset, masses_vary
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.schema import Field, changed
from contactgraph.data.trajectory import Trajectory
from contactgraph.identify.free_motion import (
    driving_components,
    fit_actuation,
    fit_slowing,
    fit_theta,
)
from contactgraph.identify.impacts import fit_impacts
from contactgraph.identify.shapes import (
    CONTACT_DISTANCE,
    all_outlined,
    distances,
    on_planes,
    plane_distances,
    with_shapes,
)
from contactgraph.inference.features import GAP_SCALES
from contactgraph.inference.motion_noise import in_lengths
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.presets import ModelConfig, Preset

_AVERAGED = 0.95
"""Share of a change of velocity that displaces in its step, from which velocities are means."""
_KEY = "contact_distance"
_BOUNCES, _SLIDES = 0.02, 1e-3
"""Bounce, and deceleration by the ground in m/s^2, up to which there is none."""


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


@dataclass(frozen=True)
class Facts:
    """What a dataset tells before a model is trained on it."""

    config: ModelConfig
    """Of the model, in `units`."""
    units: Units
    """Those of training: see `in_units`."""
    rollout_from: float
    """For `TrainConfig`: 0 where bodies have weight, because only several steps distinguish the
    mass of a lifted body from a spring that holds it; else 0.5, which is faster."""

    @property
    def in_data(self) -> ModelConfig:
        """`config` in the units of the data."""
        config, length = self.config, self.units.length
        actuation = {
            name: replace(
                fit,
                matrix=fit.matrix * length / np.array(self.units.control[: fit.matrix.shape[1]]),
                bias=fit.bias * length,
                residual=fit.residual * length,
            )
            for name, fit in config.actuation.items()
        }
        return replace(
            config,
            contact_distance=config.contact_distance * length,
            speed=config.speed * length,
            margin=config.margin * length,
            turn_length=None if config.turn_length is None else config.turn_length * length,
            plane_distance={name: far * length for name, far in config.plane_distance.items()},
            slowing={
                name: (each * length, damper) for name, (each, damper) in config.slowing.items()
            },
            actuation=actuation,
        )

    def with_contact_distance(self, distance: float) -> "Facts":
        """With this one, m in the units of the data, in place of the data's. It is learned from
        there, but where velocities are means over a step, which do not tell when in it bodies
        met."""
        told, learned = distance / self.units.length, not self.config.averaged
        config = replace(self.config, contact_distance=told, learned_contact_distance=learned)
        return replace(self, config=config)

    def in_data_units(self, model: ContactDynamics, preset: Preset) -> ContactDynamics:
        """A model that ``preset`` made for `config`, as trained, for states and controls in the
        units of the data.

        What is not learned, such as the actuation, is that of a fresh model for `in_data`.
        """
        if {self.units.length, *self.units.control} == {1.0}:
            return model

        def identified(each: Any) -> tuple[Any, ...]:
            return each.local_dynamics.head.actuation, each.local_dynamics.head.plane_distance

        def commanded(each: Any) -> Any:
            return each.inference.coefficients

        fresh: Any = preset(self.in_data, key=jax.random.key(0))
        arrays, static = eqx.partition(fresh, eqx.is_array)
        own = jax.tree.leaves(eqx.filter(model, eqx.is_array))
        moved = eqx.combine(jax.tree.unflatten(jax.tree.structure(arrays), own), static)
        moved = eqx.tree_at(identified, moved, identified(fresh))
        if fresh.features.learned:
            distance = self.units.length * model.features.contact_distance
            moved = eqx.tree_at(lambda each: each.features.contact_distance, moved, distance)
        if model.prediction_noise is not None:
            noise = in_lengths(model.prediction_noise, self.units.length, fresh.prediction_noise)
            moved = eqx.tree_at(lambda each: each.prediction_noise, moved, noise)
            count = fresh.inference.commands
            begin = len(GAP_SCALES)  # The switches follow the gap.
            unit = jnp.array(self.units.control[len(self.units.control) - count :])
            weight = commanded(moved).at[..., begin : begin + count].divide(unit)
            moved = eqx.tree_at(commanded, moved, weight)
        return moved


def scene_facts(dataset: Dataset) -> Facts:
    """What scenes tell without any fit, in the units of the data: all that the paper's forms know.

    Raises `InvalidInputError` where contact distances disagree or are not positive numbers.
    """
    given = {each.scene.metadata.get(_KEY) for each in dataset}
    if len(given) > 1:
        raise InvalidInputError(f"{_KEY} must be the same in all trajectories, found {given}")
    distance = given.pop()
    if distance is not None and not (
        isinstance(distance, int | float) and math.isfinite(distance) and distance > 0
    ):
        raise InvalidInputError(f"{_KEY} must be positive metres, found {distance!r}")
    config = ModelConfig(
        dataset.dimension,
        dataset.control_size,
        dataset.dt,
        contact_distance=CONTACT_DISTANCE if distance is None else float(distance),
        # Scenes that tell it may have fingers, which close on command at any distance.
        learned_contact_distance=distance is None,
        hinges=any(each.scene.hinged.any() for each in dataset),
    )
    weight = any(each.scene.has_weight for each in dataset)
    units = Units(1.0, (1.0,) * dataset.control_size)
    return Facts(config, units, rollout_from=0.0 if weight else 0.5)


def relation_facts(dataset: Dataset) -> Facts:
    """What the preset `relations` knows: types of bodies, and as the contact distance the median
    distance of two bodies over all pairs and states, m, the unit of force laws.

    Raises `InvalidInputError` as `scene_facts`.
    """
    facts, found = scene_facts(dataset), [np.zeros(0)]
    for each in dataset:
        first, second = np.triu_indices(each.scene.node_count, 1)
        apart = each.position[:, first] - each.position[:, second]
        found.append(np.linalg.norm(apart, axis=-1).ravel())
    distance = np.concatenate(found)
    config = replace(
        facts.config,
        contact_distance=float(np.median(distance)) if distance.size else 1.0,
        learned_contact_distance=False,
        node_types=tuple(sorted({name for each in dataset for name in each.scene.node_type})),
        edge_types=(HOLD,),
    )
    return replace(facts, config=config)


def identify(dataset: Dataset, contact_distance: float | None = None) -> Facts:
    """All that least squares and other readings tell a model of the preset `ours`.

    ``contact_distance``, m, is the caller's, see `Facts.with_contact_distance`; None: by the data.
    Raises `InvalidInputError` as `scene_facts`, where commands precede what drives, or where what
    drives acts on no node.
    """
    facts, drives = scene_facts(dataset), driving_components(dataset)
    found = with_shapes(facts.config, dataset).contact_distance
    units = units_of(dataset, contact_distance or found, CONTACT_DISTANCE)
    dataset = in_units(dataset, units)
    config = with_shapes(scene_facts(dataset).config, dataset)
    theta = fit_theta(dataset)
    averaged = theta > _AVERAGED
    substeps = 1 if averaged else config.substeps
    actuation = fit_actuation(dataset, 1.0 if averaged else theta)
    slowing = fit_slowing(dataset, config.contact_distance, distances(config))
    # Of means over a step nothing tells the velocities before and after; and those of bodies that
    # turn, nothing but the whole step.
    impacts = {} if averaged or config.inertia else fit_impacts(dataset, actuation)
    planes = plane_distances(dataset, config.inertia)
    rubs = bool(averaged or config.inertia or planes)
    rubs |= any(each.friction is not None for each in impacts.values())
    slides = any(constant > _SLIDES for constant, _ in slowing.values())
    bounces = any(each.bounce > _BOUNCES for each in impacts.values())
    # The friction of planes slows what lies on them.
    flat = (each.scene for each in dataset if dataset.dimension == 2 and on_planes(each.scene))
    borne = {name for scene in flat for name in scene.node_type if name in config.inertia}
    driven = any(each.scene.actuated.any() for each in dataset)
    config = replace(
        config,
        learned_contact_distance=config.learned_contact_distance and not averaged,
        node_types=_node_types(dataset),
        actuation=actuation,
        driving_size=int(drives.sum()),
        actuated_nodes=max(1, *(int(each.scene.actuated.sum()) for each in dataset)),
        plane_distance=planes,
        averaged=averaged,
        theta=float(np.clip(0.5 + substeps * (theta - 0.5), 0.51, 0.99)),
        substeps=substeps,
        slowing={name: each for name, each in slowing.items() if name not in borne},
        impacts=impacts,
        varying_mass=masses_vary(dataset),
        rough=rubs or slides or bounces,
        friction=1.0 if rubs else 0.0,
        identified=bool(borne) and not driven and all_outlined(dataset),
    )
    facts = replace(facts, config=config, units=units)
    return facts if contact_distance is None else facts.with_contact_distance(contact_distance)


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

    def scaled(field: Field, value: np.ndarray) -> np.ndarray:
        return value / units.length if field.of_length else value

    def converted(each: Trajectory) -> Trajectory:
        scene, metadata = each.scene, dict(each.scene.metadata)
        if isinstance(distance := metadata.get(_KEY), int | float):
            metadata[_KEY] = distance / units.length
        planes = scene.planes / np.append(np.ones(scene.dimension), units.length)
        scene = changed(scene, scaled, planes=planes, metadata=metadata)
        return changed(each, scaled, control=each.control / np.array(units.control), scene=scene)

    return dataset.map(converted)


def _node_types(dataset: Dataset) -> tuple[str, ...]:
    """Names of the types, passive ones first, the most frequent first."""
    count: Counter[tuple[bool, str]] = Counter()
    for each in dataset:
        count.update(zip(each.scene.actuated.tolist(), each.scene.node_type, strict=True))
    names = sorted(count, key=lambda each: (each[0], -count[each], each[1]))
    return tuple(dict.fromkeys(name for _, name in names))
