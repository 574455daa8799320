"""Memory of a measured contact that the geometry contradicts."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from contactgraph.data import InvalidInputError, Nodes, TrajectoryBatch, pair_count
from contactgraph.model import ContactDynamics, ContactSensor
from contactgraph.model.filter import FilteredTrajectory, dtype_of, filter_trajectory


@dataclass(frozen=True)
class Forgetting:
    """Beliefs in a contact, each the largest of all edges, about bodies that touch at rest."""

    coming: float
    """About the step after the last of the measurements, all of which reported no contact."""
    later: float
    """About a step some time later, when nothing more was measured and nothing has changed."""


def forgetting(
    model: ContactDynamics,
    sensor: ContactSensor,
    *,
    bodies: int = 2,
    measurements: int = 10,
    later_s: float = 0.5,
) -> Forgetting:
    """Beliefs of a chain of ``bodies`` at rest, neighbours touching, that are measured as free.

    The first body is actuated, and no control acts. ``later_s`` [s] is rounded to whole steps.
    Raises `InvalidInputError` for fewer than two bodies or one measurement, or a negative time.
    """
    if bodies < 2 or measurements < 1 or not 0.0 <= later_s < float("inf"):
        raise InvalidInputError(
            "forgetting needs at least 2 bodies, 1 measurement and a time of at least 0 s, found "
            f"{bodies}, {measurements} and {later_s:g} s"
        )
    dtype, edges = dtype_of(model), pair_count(bodies)
    last = measurements - 1 + round(later_s / model.dt)
    distance = float(model.features.contact_distance)
    place = np.zeros((bodies, model.dimension), dtype)
    place[:, 0] = distance * np.arange(bodies)
    contact = np.full((last + 1, edges), np.nan, dtype)
    contact[:measurements] = 0.0
    hinges = getattr(model.features, "hinges", False)
    chain = TrajectoryBatch(
        position=jnp.broadcast_to(place, (last + 1, *place.shape)),
        velocity=jnp.zeros((last + 1, *place.shape), dtype),
        control=jnp.zeros((last, model.control_size), dtype),
        contact=jnp.asarray(contact),
        nodes=Nodes(
            actuated=jnp.arange(bodies) == 0,
            mask=jnp.ones(bodies, bool),
            candidate=jnp.ones(edges, bool),
            anchor=jnp.full_like(place, jnp.nan) if hinges else None,
        ),
        steps=jnp.asarray(last),
    )
    found: FilteredTrajectory = eqx.filter_jit(filter_trajectory)(model, chain, sensor)
    belief = np.asarray(sensor.contact_probability(found.prior)).max(axis=-1)
    return Forgetting(float(belief[measurements - 1]), float(belief[last]))
