"""Choices of a training that follow from its data: the model, its properties, and units."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from contactgraph.data import Dataset
    from contactgraph.model import ContactDynamics, ModelConfig
    from contactgraph.train.units import Units


@dataclass(frozen=True)
class Recipe:
    """Choices for one training; an option of the command overrides each."""

    name: str
    """Of the model's preset."""
    seed: int
    dataset: "Dataset"
    """In the units of training."""
    config: "ModelConfig"
    """In the units of training."""
    in_data: "ModelConfig"
    """In those of the data."""
    rollout_from: float
    units: "Units | None"
    """None: those of the data."""

    @property
    def length(self) -> float:
        """The unit of lengths in training, in the data's."""
        return 1.0 if self.units is None else self.units.length

    def model(self) -> "ContactDynamics":
        """With fresh weights, in the units of training."""
        return self._build(self.config)

    def in_data_units(self, model: "ContactDynamics") -> "ContactDynamics":
        """A trained model, for the data."""
        from contactgraph.train.units import in_data_units

        if self.units is None:
            return model
        return in_data_units(model, self._build(self.in_data), self.units)

    def _build(self, config: "ModelConfig") -> "ContactDynamics":
        import jax

        from contactgraph.cli.models import model_preset

        return model_preset(self.name)(config, key=jax.random.key(self.seed))

    def lines(self) -> list[str]:
        """What was chosen, and why, for people."""
        config = self.in_data
        learned = "learned from there" if config.learned_contact_distance else "kept"
        rows = {
            "model": self.name,
            "contact distance": f"{config.contact_distance:.4g}, {learned}",
            "rollouts": f"in the loss from {100 * self.rollout_from:.0f} % of the steps on",
        }
        if self.name == "relations":
            rows = {"model": rows["model"], "unit of laws": f"{config.contact_distance:.4g} m"}
        if self.units is not None:
            known = ", ".join(name.removesuffix("_raw") for name in config.told)
            planes = ", ".join(f"{name} {far:.3g}" for name, far in config.plane_distance.items())
            rows |= {
                "types": f"{', '.join(config.node_types)}; {config.actuated_nodes} actuated",
                "actuation": "; ".join(f"{n}: {fit}" for n, fit in config.actuation.items())
                or "none",
                "shapes": f"outlines of {', '.join(config.inertia)}, which turn"
                if config.inertia
                else ("boxes of their size" if config.boxes else "round"),
                "parts of a step": f"{config.substeps}, in each of which contacts are found",
                "learned": "bounce, friction and inertia, by simulated steps"
                if config.identified
                else "by gradients" + (f"; by the data alone: {known}" if known else ""),
                "planes": f"touched at {planes}" if planes else "none",
                "slowed": ", ".join(
                    f"{name} by {constant:.3g} and {by_speed:.3g} 1/s"
                    for name, (constant, by_speed) in config.slowing.items()
                )
                or "not seen",
                "impacts": ", ".join(
                    f"{one} on {other} bounce {law.bounce:.2g}"
                    + ("" if law.friction is None else f", friction {law.friction:.2g}")
                    for (one, other), law in config.impacts.items()
                )
                or "not seen",
                "velocities": "means over a step" if config.averaged else "at the end of a step",
                "unit of length": f"{self.units.length:g} of the data's",
            }
        return [f"  {name:<17} {text}" for name, text in rows.items()]


def recipe(
    dataset: "Dataset",
    model: str = "ours",
    *,
    seed: int = 0,
    contact_distance: float | None = None,
    edge_types: int | None = None,
    rollout_from: float | None = None,
    paper: Mapping[str, Any] = MappingProxyType({}),
) -> Recipe:
    """None: by the data. ``paper`` has the fields of `ModelConfig` for the paper's forms.

    Raises `InvalidInputError` where data and options do not fit.
    """
    from contactgraph.data import InvalidInputError
    from contactgraph.model import ModelConfig
    from contactgraph.train import body_defaults, defaults_from_data
    from contactgraph.train.config import CONTACT_DISTANCE
    from contactgraph.train.units import in_units, typical_distance, units_of

    defaults = defaults_from_data(dataset)
    names = "contact_distance", "learned_contact_distance"
    given: dict[str, Any] = {name: getattr(defaults, name) for name in names}
    units, length = None, 1.0
    if model.startswith("ours") and model != "ours-full-ab":
        given = vars(body_defaults(dataset))
        units = units_of(dataset, contact_distance or given[names[0]], CONTACT_DISTANCE)
        length = units.length

    if model == "relations":
        if defaults.hinges:
            raise InvalidInputError("--model relations: it has no hinges, but some bodies have")
        types = (name for each in dataset for name in each.scene.node_type)
        distance = typical_distance(dataset)
        given = dict(zip(names, (distance, False), strict=True))
        given["node_types"] = tuple(sorted(set(types)))

    def config(given: dict[str, Any], speed: float) -> ModelConfig:
        if contact_distance is not None:
            told = contact_distance * speed / length
            given = given | {names[0]: told, names[1]: not given.get("averaged", False)}
        return ModelConfig(
            dataset.dimension,
            dataset.control_size,
            dataset.dt,
            speed=speed,
            hinges=defaults.hinges,
            edge_types=(2 if model == "relations" else 3) if edge_types is None else edge_types,
            **paper,
            **given,
        )

    in_data = config(given, length)
    if units is not None:
        dataset = in_units(dataset, units)
        given = vars(body_defaults(dataset))
    return Recipe(
        name=model,
        seed=seed,
        dataset=dataset,
        config=config(given, 1.0),
        in_data=in_data,
        rollout_from=defaults.rollout_from if rollout_from is None else rollout_from,
        units=units,
    )
