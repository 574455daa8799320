"""Starts of couplings, and the springs of hinged bodies."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.model.shapes import hinge_constraint
from contactgraph.model.types import LocalInput, SpringMassDamper, Step

_MIN_SHARE = 1e-6


def coupling_starts(active_types: int) -> np.ndarray:
    """[active] logits at which the couplings of the types start.

    A touch and the first type that holds start rigid, further ones apart from each other, spread
    over (0, 1): types that start alike share all data evenly, and stay alike.
    """
    further = np.arange(1, active_types - 1)
    return np.append(np.full(min(active_types, 2), 5.0), np.log((active_types - 1) / further - 1.0))


def with_hinge_springs(
    parameters: SpringMassDamper,
    local: LocalInput,
    coupling: Float[Array, " E"],
    step: Step,
    change: Float[Array, "N D"],
) -> SpringMassDamper:
    """The parameters with the springs that keep bodies turning about their hinges; ``change`` [m/s]
    is that of their velocities by contacts."""
    assert local.anchor is not None and parameters.acceleration is not None
    theta, dt = step.theta, step.dt
    constraint = hinge_constraint(
        local.anchor,
        local.position,
        local.velocity + change,
        coupling,
        local.geometry.edge_index,
        local.geometry.relative_velocity,
    )
    own = parameters.stiffness_rate
    before = 1.0 + theta * (dt * parameters.damping_rate) + theta**2 * dt**2 * own
    stiffness = constraint.stiffness_rate[:, None] * before  # as stiff whatever the damper does
    after = before + theta**2 * dt**2 * stiffness
    sprung = dataclasses.replace(
        parameters,
        response=parameters.response * (after / before)[..., None],
        stiffness_rate=stiffness + own,
        equilibrium=(stiffness * constraint.center + own * parameters.equilibrium)
        / jnp.maximum(stiffness + own, _MIN_SHARE),
        acceleration=(acceleration := parameters.acceleration * (after / before)),
    )
    moved = local.position + theta * dt * local.velocity
    pull = dt * (acceleration - stiffness * (moved - constraint.center))
    # The position after the step without control; see `ThetaMethod`.
    displacement = sprung.impact_displacement
    position = local.position + dt * (local.velocity + theta * pull / after) + displacement
    return dataclasses.replace(
        sprung, impact_displacement=displacement + constraint.projection(position)
    )
