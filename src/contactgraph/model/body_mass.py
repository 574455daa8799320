"""Masses that differ within a type: a belief about each body's, which observed motion corrects.

A body has exp(z) times the mass of its type. Before its motion tells anything, z is normal with the
learned spread of the type; each observed step corrects it by a step of an iterated extended Kalman
filter (Bell and Cathey 1993), whose measurement is the velocity after the step.
"""

import dataclasses
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Float

from contactgraph.data.graph import pair_indices
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.dynamics.body_types import PACE
from contactgraph.inference.contact_belief import ContactBelief
from contactgraph.inference.motion_noise import Motion, MotionNoise
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.motion_likelihood import (
    both_finite,
    check_motion_model,
    most_probable,
    motion_given_types,
)
from contactgraph.model.step import ModelState, StepModel

_ITERATIONS = 2
"""Linearisations a step from each beginning: an impact is far from linear in the mass."""
_CHANGE = 0.1
"""Of the logarithm of a mass, from which a step is linearised."""


class MassBelief(eqx.Module):
    """A normal belief about the logarithm of every body's mass, in units of that of its type."""

    mean: Float[Array, "*T N"]
    variance: Float[Array, "*T N"]

    def interval(self, probability: float = 0.9) -> tuple[Float[Array, "*T N"], ...]:
        """Bounds of the mass in units of the type's, between which it is with a probability."""
        half = ndtri(0.5 * (1.0 + probability)) * jnp.sqrt(self.variance)
        return jnp.exp(self.mean - half), jnp.exp(self.mean + half)


Masses = TypeVar("Masses", bound=MassBelief | None)


def varying_types(model: Any) -> Any:
    """The types of bodies of a model in which masses differ within a type, else None."""
    types = getattr(getattr(model, "local_dynamics", None), "head", None)
    return None if getattr(types, "log_spread", None) is None else types


def first_masses(model: Any, nodes: Nodes) -> MassBelief | None:
    """The belief before any motion; None where all bodies of a type weigh alike.

    Masses that the ``nodes`` tell, and those of actuated nodes, are certain.
    """
    head = varying_types(model)
    if head is None:
        return None
    types = model.features.node_type(nodes, head.log_mass.dtype)
    spread = jnp.exp(PACE * types @ head.log_spread)
    if nodes.log_mass is not None:
        return MassBelief(nodes.log_mass, jnp.zeros_like(spread))
    return MassBelief(jnp.zeros_like(spread), jnp.where(nodes.passive, spread**2, 0.0))


def with_masses(nodes: Nodes, masses: MassBelief | None) -> Nodes:
    """The nodes with the most probable masses; as given for None."""
    return nodes if masses is None else nodes._replace(log_mass=masses.mean)


def correct_masses(
    model: StepModel,
    masses: Masses,
    before: ModelState,
    belief: ContactBelief,
    control: Float[Array, " U"],
    observed: Motion,
    nodes: Nodes,
    noise: MotionNoise | None,
) -> Masses:
    """The belief after one observed step; ``belief`` is about the contacts in it.

    As given without a ``noise``, or where one of the two observations is not finite.
    """
    if masses is None or noise is None:
        return masses
    judge = check_motion_model(model)
    types, usable = most_probable(belief), both_finite(before, observed)
    position, velocity_before, after = map(
        jnp.nan_to_num, (before.position, before.velocity, observed[1])
    )
    before = dataclasses.replace(before, position=position, velocity=velocity_before)

    def velocity(mean: Float[Array, " N"], types: Float[Array, "E K"]) -> Float[Array, "N G"]:
        weighed = nodes._replace(log_mass=mean)
        return motion_given_types(judge, position, velocity_before, control, weighed, types)[1]

    count = len(position)
    # Not the learned ones: an effect wrong in all steps alike would seem to tell a mass exactly.
    share = noise.model_share * jnp.sum(types[:, 1:], axis=-1)
    incidence = jnp.any(pair_indices(count)[..., None] == jnp.arange(count), axis=1)
    share = jnp.max(incidence * share[:, None], axis=0, initial=0.0)
    base = 2.0 * noise.velocity**2 + noise.model_velocity**2
    spread = jnp.where(share > 0.0, jnp.sqrt(masses.variance), 0.0)
    # In one program: with another mass of each body in turn, as believed, and without contacts. The
    # step's own gradient leaves out what bounds friction.
    changes = _CHANGE * jnp.eye(count + 2, count)
    free = jnp.zeros_like(types).at[:, 0].set(1.0)
    each = jnp.stack([types] * (count + 1) + [free])

    def iterate(z: Float[Array, " N"], _: None) -> tuple[Array, tuple[Array, Array, Array]]:
        """From the masses that are ``z`` standard deviations away: by how many those after it are,
        how badly those before it fit, and the share of the variance that is left."""
        mean = masses.mean + spread * z
        *changed, predicted, unhindered = jax.vmap(velocity)(mean + changes, each)
        slope = (jnp.stack(changed, axis=-1) - predicted[..., None]) / _CHANGE
        # Both known up to a share, so that no step tells a mass better than that.
        effect = jnp.sum((predicted - unhindered) ** 2 + jnp.sum(slope**2, axis=-1), axis=-1)
        variance = (base + share**2 * effect)[:, None]
        error = jnp.where(nodes.mobile[:, None], after - predicted, 0.0)
        # Student's t: an outlier, such as a contact that was judged wrongly, has less weight.
        weight = (noise.tail + 1.0) / (noise.tail + error**2 / variance) / variance
        scaled = slope * spread
        precision = jnp.einsum("ngi,ng,ngj->ij", scaled, weight, scaled)
        inverse = jnp.linalg.inv(precision + jnp.eye(count))
        improved = inverse @ jnp.einsum("ngi,ng,ng->i", scaled, weight, error + scaled @ z)
        misfit = (noise.tail + 1.0) * jnp.log1p(error**2 / (noise.tail * variance))
        misfit = jnp.sum(nodes.mobile[:, None] * (misfit + jnp.log(variance))) + jnp.sum(z**2)
        return improved, (misfit, improved, jnp.diagonal(inverse))

    # The motion hardly depends on a mass that is much too large: a Newton step leads nowhere there.
    starts = jnp.ones(count) * np.array([[0.0], [-1.0], [1.0]])
    found = jax.vmap(lambda z: jax.lax.scan(iterate, z, length=_ITERATIONS)[1])(starts)
    best = jnp.argmin(found[0][:, -1])
    _, z, share_left = jax.tree.map(lambda leaf: leaf[best, -1], found)
    corrected = MassBelief(masses.mean + spread * z, masses.variance * share_left)
    return jax.tree.map(lambda new, old: jnp.where(usable, new, old), corrected, masses)


def trajectory_masses(
    model: ContactDynamics,
    first: MassBelief,
    states: tuple[Float[Array, "T+1 N G"], Float[Array, "T+1 N G"]],
    controls: Float[Array, "T U"],
    types: Float[Array, "T E K"],
    nodes: Nodes,
    noise: MotionNoise,
) -> MassBelief:
    """The belief after all steps of a trajectory or a window, ``first`` before them."""

    def step(masses: MassBelief, inputs: tuple) -> tuple[MassBelief, None]:
        position, velocity, control, types, after = inputs
        belief = ContactBelief(types, edge_types=model.inference.edge_types)
        weighed = with_masses(nodes, masses)
        before = ModelState(position, velocity, belief)
        masses = correct_masses(model, masses, before, belief, control, after, weighed, noise)
        return masses, None

    position, velocity = states
    after = position[1:], velocity[1:]
    inputs = position[:-1], velocity[:-1], controls, types, after
    return jax.lax.scan(step, first, inputs)[0]


def mass_score(model: ContactDynamics, masses: MassBelief, nodes: Nodes) -> Float[Array, " N"]:
    """Negative log-likelihood, nat, of beliefs that motion has led to, by which the mean and the
    spread of the masses of a type are learned."""
    head = varying_types(model)
    types = model.features.node_type(nodes, head.log_mass.dtype)
    own, log_spread = PACE * types @ head.log_mass, PACE * types @ head.log_spread
    away = jax.lax.stop_gradient(masses.mean + own) - own
    return 0.5 * (away**2 + masses.variance) * jnp.exp(-2.0 * log_spread) + log_spread
