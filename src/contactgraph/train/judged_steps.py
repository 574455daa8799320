"""The likelihood of every recorded step's motion, which training learns from without gradient."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from contactgraph.model.contact_belief import (
    ContactBelief,
    first_holding_type,
    without_change,
)
from contactgraph.model.contact_dynamics import ContactDynamics, EncodedGraph
from contactgraph.model.motion_likelihood import (
    edge_log_ratios,
    most_probable,
    motion_noise,
    posterior_by_motion,
)
from contactgraph.model.motion_noise import Motion
from contactgraph.model.types import ModelState
from contactgraph.train.batch import Window, WindowSource
from contactgraph.train.loss import WindowSteps

_JUDGED, _FILTERED = 32, 12
"""Trajectories that are judged at once, and those of them on which the filter is scored a step."""
_DISPLACEMENT = 0.01
"""Most displacement of nodes, in contact distances; standard deviation."""


class JudgedSteps(eqx.Module):
    """What the motion of every step of a batch of windows says, without gradient."""

    displacement: Float[Array, "B L N D"]
    """m; displacement of each node by each step's control alone."""
    log_ratio: Float[Array, "B L E K K"]
    """`edge_log_ratios`."""
    types: Float[Array, "B L E K"]
    """The likeliest type of each edge in each step, one-hot."""
    unhindered: Motion
    """[B, L, N, D] m and m/s; where each step would lead without edges."""


def without_gradient(model: ContactDynamics) -> ContactDynamics:
    """The model, of which no gradient is taken."""
    arrays, others = eqx.partition(model, eqx.is_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), others)


def held_where_near(prior: ContactBelief) -> Float[Array, "E K"]:
    """One-hot types of edges not judged yet: the first that holds, where contact is likely.

    The prior does not tell touch from hold. Bodies that are held in a group move as they do
    because of all its bonds: were the others taken for touches, each would seem to be one, and the
    dynamics would learn masses with which that is true.
    """
    types = prior.type_probability.shape[-1]
    index = jnp.where(prior.type_probability[..., 0] < 0.5, first_holding_type(types), 0)
    return jax.nn.one_hot(index, types, dtype=prior.type_probability.dtype)


def judge_steps(model: ContactDynamics, windows: Window, devices: int = 1) -> JudgedSteps:
    """The likelihood of the recorded motion of every step."""
    model = without_gradient(model)
    steps, noise = WindowSteps(model, windows, devices), motion_noise(model)

    def judge(graph: EncodedGraph, control: Array, after: Motion) -> tuple[Array, Array]:
        prior = model.prior_belief(graph)
        state = ModelState(graph.position, graph.velocity, prior)
        joint = without_change(prior, noise.error_floor)
        first = held_where_near(prior)
        ratio = edge_log_ratios(model, graph, state, joint, control, after, noise, first)
        return ratio, most_probable(posterior_by_motion(prior, joint, ratio))

    def linear(graph: EncodedGraph, types: Array, control: Array) -> tuple[Array, Motion]:
        dynamics = model.linearize(model.cut_edges(graph, ContactBelief(types)))
        moved = dynamics(graph.position, graph.velocity, control)
        return dynamics.control_sensitivity, moved

    free = steps.encode(None)
    inactive = jnp.zeros_like(free.prior).at[..., 0].set(1.0)
    sensitivity, unhindered = steps.each(linear, free, inactive, windows.control)
    graph = steps.encode(steps.displacement(sensitivity))
    ratio, types = steps.each(judge, graph, windows.control, steps.after)
    sensitivity, _ = steps.each(linear, graph, types, windows.control)
    return JudgedSteps(steps.displacement(sensitivity), ratio, types, unhindered)


class JudgedTrajectories(eqx.Module):
    """Whole trajectories whose motion was judged by an earlier model of the same training.

    Judging takes longer than learning from it, and the likelihoods change slowly.
    """

    trajectories: Window
    step_mask: Bool[Array, "B T"]
    contact: Float[Array, "B T+1 E"] | None
    """Recorded contacts where training uses them."""
    judged: JudgedSteps

    def draw(self, distance: Float[Array, ""] | float, key: PRNGKeyArray) -> "JudgedTrajectories":
        """Some of them; in half of these every node is displaced by a little of ``distance`` [m].

        In recordings bodies that hold each other are exactly a contact distance apart. In rollouts
        they are not quite, and a filter that has never seen this takes them for free.
        """
        keys = jax.random.split(key, 3)
        index = jax.random.randint(keys[0], (_FILTERED,), 0, len(self.step_mask))
        drawn = jax.tree.map(lambda leaf: leaf[index], self)
        first = drawn.trajectories.position[:, :1]
        scale = jnp.maximum(jax.random.uniform(keys[1], (_FILTERED, 1, 1, 1), minval=-1.0), 0.0)
        offset = _DISPLACEMENT * jax.lax.stop_gradient(distance) * scale
        offset = offset * jax.random.normal(keys[2], first.shape)
        return eqx.tree_at(
            lambda each: each.trajectories.position, drawn, drawn.trajectories.position + offset
        )


def judge_trajectories(
    model: ContactDynamics, source: WindowSource, key: PRNGKeyArray
) -> JudgedTrajectories:
    """Draws trajectories and judges them."""
    drawn, step_mask, contact = source.draw_trajectories(_JUDGED, key)
    return JudgedTrajectories(drawn, step_mask, contact, judge_steps(model, drawn))
