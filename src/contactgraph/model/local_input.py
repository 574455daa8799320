"""What local dynamics are computed from."""

import equinox as eqx
from jaxtyping import Array, Float

from contactgraph.model.geometry import Geometry


class LocalInput(eqx.Module):
    """One step's state and the graph that is left when inactive edges are cut."""

    position: Float[Array, "N D"]
    """m"""
    velocity: Float[Array, "N D"]
    """m/s"""
    kind: Float[Array, "N kinds"]
    """What of a node does not change."""
    actuated: Float[Array, " N"]
    """1 where the control acts on the node itself, else 0."""
    node_features: Float[Array, "N F"]
    edge_features: Float[Array, "2 E G"]
    weight: Float[Array, "E active"]
    """How active each edge is of each active type; 0 where it does not exist."""
    geometry: Geometry
    anchor: Float[Array, "N D"] | None
    """m; where a node is hinged, NaN where it is not. None: nobody is."""
    room: int | None = eqx.field(static=True, default=None)
    """For so many nodes that hold each other, directly or through others; None: for all."""


class Step(eqx.Module):
    """The step that local dynamics are made for."""

    theta: Float[Array, ""]
    """Of the `ThetaMethod` that will make it discrete."""
    dt: float = eqx.field(static=True)
    """s"""
    control_size: int = eqx.field(static=True)
