"""Contacts that need no belief: those of nodes with planes, and pins."""

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
