"""Contacts that need no belief: those of nodes with planes, and pins."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.geometry import Geometry
from contactgraph.bodies.pins import PinJoints
from contactgraph.bodies.planes import meets_plane
from contactgraph.model.contacts import MAX_COUPLING, Contacts, damper_of


def plane_contacts(
    geometry: Geometry,
    *,
    softness: float,
    bounce: Float[Array, " C"],
    friction: Float[Array, " C"],
    displacing_fraction: Float[Array, " C"],
    averaged: bool,
) -> Contacts:
    """Touches of a `plane_geometry`, with these coefficients of ``bounce`` and ``friction``.

    They act where a node approaches by more than about ``softness`` [m]; ``averaged``: see
    `ContactLaw`.
    """
    closing = meets_plane(geometry) * jax.nn.sigmoid(geometry.approach / softness)
    nothing = jnp.zeros_like(closing)
    return Contacts(
        geometry=geometry,
        damper=damper_of(closing),
        spring=nothing,
        rest_length=nothing,
        touching=nothing + 1.0,
        displacing_fraction=displacing_fraction,
        acting=1.0 - geometry.time_of_impact * averaged,
        bounce=closing * bounce,
        friction=friction,
        until_impact=geometry.time_of_impact * (1.0 - averaged),
    )


def pin_contacts(pins: PinJoints, geometry: Geometry) -> Contacts:
    """Contacts that always act, in all directions, at the `PinJoints.geometry`."""
    exists = pins.exists.astype(geometry.distance.dtype)
    nothing = jnp.zeros_like(exists)
    return Contacts(
        geometry=geometry,
        damper=damper_of(exists),
        spring=nothing,
        rest_length=nothing,
        touching=nothing,
        displacing_fraction=nothing,
        acting=nothing + 1.0,
        bounce=MAX_COUPLING * exists,
        friction=nothing,
        until_impact=nothing,
        pinned=exists,
    )


def with_pins(
    contacts: Contacts,
    local: Any,
    driven: Float[Array, "N G"],
    mass: Float[Array, "N G"],
    turn_length: float | None,
    dt: float,
) -> tuple[Contacts, PinJoints | None]:
    """The contacts, then the pins of nodes of this ``mass`` [kg], and these, None where there are
    none. ``local`` is a `LocalInput`; ``driven`` m/s is what the control adds to the mean velocity.
    """
    nodes, turns, velocity = local.nodes, local.turns, local.velocity
    if nodes.pins is None or turns is None or turn_length is None:
        return contacts, None
    assert nodes.pin_points is not None
    pins = PinJoints(
        nodes=nodes.pins,
        points=nodes.pin_points.astype(mass.dtype),
        inverse_mass=jnp.where(nodes.mobile[:, None], 1.0 / mass, 0.0),
        turns=turns,
        turn_length=turn_length,
    )
    geometry = pins.geometry(local.position, velocity, dt * (velocity + driven))
    return contacts.and_also(pin_contacts(pins, geometry)), pins
