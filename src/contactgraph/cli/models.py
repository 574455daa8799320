"""Models by name: presets to train, and model files."""

import dataclasses
import re
from pathlib import Path
from typing import TYPE_CHECKING

from contactgraph.bodies.graph import first_where
from contactgraph.data import Dataset, InvalidInputError, subsample
from contactgraph.data.lookup import choice, load_object
from contactgraph.identify import Facts
from contactgraph.model import (
    PRESETS,
    ContactDynamics,
    ContactSensor,
    DistancePrior,
    MotionNoise,
    Preset,
    PriorEdges,
    check_motion_model,
    describe_model,
    load_model,
    motion_noise,
    shipped_model,
    shipped_models,
)

if TYPE_CHECKING:
    from contactgraph.train import HeldOutBaselines

_MADE_BY = re.compile(r"(?P<preset>[\w.]+:[\w.]+)@(?P<name>.+)")
_STEP_TOLERANCE = 1e-6
"""Relative difference of time steps that counts as none."""


def model_preset(name: str) -> Preset:
    """The preset of a name, or a function ``module:factory`` that is called like a preset."""
    return load_object("--model", name) if ":" in name else choice("--model", name, PRESETS)


def run_folder(name: str) -> Path | None:
    """The run folder in a ``MODEL`` argument; None for a model file or a shipped model."""
    path = Path(_split(name)[1])
    return path if path.is_dir() else None


def model_path(name: str) -> Path:
    """The file of a ``MODEL`` argument: of a run folder, itself, or of a shipped model.

    Raises `InvalidInputError` if there is none.
    """
    _, name = _split(name)
    path = Path(name)
    if path.is_file():
        return path
    if path.is_dir():
        inside = path / "model.safetensors"
        if inside.is_file():
            return inside
        raise InvalidInputError(
            f"{name}: has no model.safetensors; it must be a folder that train has made"
        )
    if name in shipped_models():
        return shipped_model(name)
    raise InvalidInputError(
        f"{name}: no such run folder or model file; models that ship are "
        f"{', '.join(shipped_models())}"
    )


def stored_model(name: str | Path) -> ContactDynamics:
    """The model of a ``MODEL`` argument: a run folder, a model file, or a shipped model.

    ``module:factory@MODEL`` rebuilds one with parts that are not of this package by the preset
    that made it. Raises `InvalidInputError` as `load_model` does. `contactgraph.load` is this.

    >>> import contactgraph
    >>> contactgraph.load("pickup")
    ContactDynamics(DurationEdges, D=2, U=2, dt=0.05 s)
    """
    preset, _ = _split(str(name))
    return load_model(model_path(str(name)), model_preset(preset) if preset else None).model


def data_simulator(name: str) -> str | None:
    """The simulator that recorded the data of a ``MODEL`` argument; None where no file tells."""
    data = describe_model(model_path(name)).training.get("data")
    simulator = data.get("simulator") if isinstance(data, dict) else None
    return simulator if isinstance(simulator, str) else None


def motion_evidence(
    model: ContactDynamics, ignored: bool, position: float = 0.0, velocity: float = 0.0
) -> MotionNoise | None:
    """The noise by which motion corrects beliefs, with that of observations, m and m/s.

    None: motion does not correct beliefs, because it is ignored (``--ignore-motion``), or because
    the model cannot judge it.
    """
    try:
        return None if ignored else motion_noise(check_motion_model(model), position, velocity)
    except InvalidInputError:
        return None


def with_inference(model: ContactDynamics, name: str) -> ContactDynamics:
    """The model with the inference of ``--inference``.

    The geometric prior knows no types, so ``prior-touch`` and ``prior-hold`` say which one all its
    active edges have. Of two types they are the same. With ``none`` no edge is ever active.
    """
    types = model.inference.edge_types
    active_types = {
        "filter": None,
        "prior-touch": first_where(each.unilateral for each in types),
        "prior-hold": first_where(each.holds for each in types),
        "none": 0,
    }
    active_type = choice("--inference", name, active_types)
    if active_type is None:
        return model
    return dataclasses.replace(model, inference=PriorEdges(types, active_type))


def contact_distance_text(model: ContactDynamics) -> str:
    """The distance of touching bodies' centres that the model assumes, for users."""
    distance = contact_distance(model)
    learned = getattr(model.features, "learned", False)
    origin = "learned" if learned else "given"
    return "unknown" if distance is None else f"{distance:.4g} m, {origin}"


def held_out_text(error: float, baselines: "HeldOutBaselines", best: float | None = None) -> str:
    """The held-out error, the best so far if given, and the baselines, for users."""
    bodies = "moving bodies" if baselines.moving else "all bodies"
    return (
        f"held-out error {100 * error:.3f} cm"
        + ("" if best is None else f" (best {100 * best:.3f})")
        + f", constant velocity {100 * baselines.constant_velocity_rmse_m:.3f}, "
        f"standing still {100 * baselines.standing_still_rmse_m:.3f}, {bodies}"
    )


def sensor_text(sensor: ContactSensor) -> str:
    """The errors of a contact sensor, for users."""
    what = "touch" if sensor.reports_touch else "holding"
    late = f", {sensor.delay} steps late" if sensor.delay else ""
    return (
        f"reports {what}{late}; false alarms {100 * sensor.false_alarm:.3g} %, "
        f"misses {100 * sensor.miss:.3g} %"
    )


def contact_distance(model: ContactDynamics) -> float | None:
    """The distance of touching bodies' centres in the contact prior, m, learned where it may be.

    None for parts of the user's own without one.
    """
    if isinstance(model.prior, DistancePrior):
        return model.prior.threshold
    distance = getattr(model.features, "contact_distance", None)
    return None if distance is None else float(distance)


def _split(name: str) -> tuple[str, str]:
    """Preset, empty without one, and model of ``module:factory@MODEL``."""
    made_by = _MADE_BY.fullmatch(name)
    return (made_by["preset"], made_by["name"]) if made_by else ("", name)


def in_steps_of(model: object, dataset: Dataset, name: str) -> Dataset:
    """The dataset, subsampled if the model's time step is a multiple of its own.

    ``name`` is the dataset's, for the line that is printed then. Other time steps are left for
    the check that model and data fit.
    """
    dt = getattr(model, "dt", dataset.dt)
    every = round(dt / dataset.dt)
    if every < 2 or abs(every * dataset.dt - dt) > _STEP_TOLERANCE * dt:
        return dataset
    print(f"{name}: every {every}th step is taken, since the model's are {dt:g} s long")
    return subsample(dataset, every)


def facts_text(model: str, facts: Facts) -> str:
    """What was chosen for a model by its name, and why, for people."""
    config = facts.in_data
    learned = "learned from there" if config.learned_contact_distance else "kept"
    rows = {
        "model": model,
        "contact distance": f"{config.contact_distance:.4g}, {learned}",
        "rollouts": f"in the loss from {100 * facts.rollout_from:.0f} % of the steps on",
    }
    if model == "relations":
        rows = {"model": model, "unit of laws": f"{config.contact_distance:.4g} m"}
    elif config.node_types:
        known = ", ".join(name.removesuffix("_raw") for name in config.told)
        by_gradients = "by gradients" + (f"; by the data alone: {known}" if known else "")
        shapes = "boxes of their size" if config.boxes else "round"
        turning = f"outlines of {', '.join(config.inertia)}, which turn"
        planes = ", ".join(f"{name} {far:.3g}" for name, far in config.plane_distance.items())
        slowed = (
            f"{name} by {constant:.3g} and {by_speed:.3g} 1/s"
            for name, (constant, by_speed) in config.slowing.items()
        )
        impacts = (
            f"{one} on {other} bounce {law.bounce:.2g}"
            + ("" if law.friction is None else f", friction {law.friction:.2g}")
            for (one, other), law in config.impacts.items()
        )
        rows |= {
            "types": f"{', '.join(config.node_types)}; {config.actuated_nodes} actuated",
            "actuation": "; ".join(f"{n}: {fit}" for n, fit in config.actuation.items()) or "none",
            "shapes": turning if config.inertia else shapes,
            "parts of a step": f"{config.substeps}, in each of which contacts are found",
            "learned": "bounce, friction and inertia, by simulated steps"
            if config.identified
            else by_gradients,
            "planes": f"touched at {planes}" if planes else "none",
            "slowed": ", ".join(slowed) or "not seen",
            "impacts": ", ".join(impacts) or "not seen",
            "velocities": "means over a step" if config.averaged else "at the end of a step",
            "unit of length": f"{facts.units.length:g} of the data's",
        }
    return "\n".join(f"  {name:<17} {text}" for name, text in rows.items())
