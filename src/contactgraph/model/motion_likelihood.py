r"""Contact without a sensor: likelihood of the observed motion with each type of each edge.

For an edge e, the model predicts the last step with each of its types, all others as is most
probable. The evidence is how well each pair of types (i at first, j in the end) fits the
observation beside the edge without contact,

$$ \ell_{ij} = \log p(x_{t+1} | x_t, u_t, e: i \to j)
   - \log p(x_{t+1} | x_t, u_t, e\ \text{inactive}), $$

and the predicted probabilities of the pairs are multiplied by $e^{\ell_{ij}}$. Where all
predictions are the same motion, $\ell = 0$, and the belief stays as predicted.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.geometry import Meeting, geometry
from contactgraph.bodies.graph import EncodedGraph
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.inference.contact_belief import (
    ContactBelief,
    cast_like,
    likeliest_type,
    pair_posterior,
    posterior_by_motion,
)
from contactgraph.inference.motion_noise import Motion, MotionNoise
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.step import ModelState

_CONSIDERED = 8
"""Edges considered in a step, nearest first: rarely do more bodies make contact at once, and the
cost of a control step must not grow with the square of the number of bodies."""
_LEAST_WEIGHT = 0.5
"""Of the cutoff, from which an edge is considered: bodies far beyond contact have none."""


def motion_noise(
    model: ContactDynamics, position: float = 0.0, velocity: float = 0.0
) -> MotionNoise:
    """The model's own noise where it has learned one, and that of observations, m and m/s."""
    learned = model.prediction_noise
    if learned is None:
        return MotionNoise(position, velocity)
    return MotionNoise(
        position,
        velocity,
        model_position=learned.position,
        model_velocity=learned.velocity,
        type_share=learned.share,
    )


def check_motion_model(model: Any) -> ContactDynamics:
    """The model, if motion can be judged by it; else raises `InvalidInputError`."""
    if not hasattr(model, "predict_joint"):
        raise InvalidInputError(
            "motion_noise: the model must be a ContactDynamics, which predicts the motion with and "
            f"without each contact, found {type(model).__name__}"
        )
    if model.neighbor_list is not None:
        raise InvalidInputError(
            "motion_noise: all pairs are judged, so the model must have no neighbor list"
        )
    if getattr(getattr(model.local_dynamics, "head", None), "identified", False):
        raise InvalidInputError("motion_noise: outlines alone tell where this model's bodies touch")
    return model


def both_finite(before: ModelState, observed: Motion) -> Bool[Array, ""]:
    """Whether both observations of a step are finite."""
    arrays = (before.position, before.velocity, *observed)
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(one)) for one in arrays]))


def correct_by_motion(
    model: ContactDynamics,
    carried: ContactBelief,
    before: ModelState,
    control: Float[Array, " U"],
    observed: Motion,
    nodes: Nodes,
    noise: MotionNoise,
) -> ContactBelief:
    """The belief about the step from ``before`` under the applied ``control`` [N] to ``observed``.

    ``before.belief`` is about the step that led to ``before``, corrected by all that was known
    then. Edges are judged one by one, unless the model has a ``with_motion`` of its own, as that of
    relations. The result is ``carried``, as predicted, where one of the step's two observations is
    not finite: the first of a trajectory has none before it, and a bad one is no evidence for
    either of its steps.
    """

    def by_edge() -> ContactBelief:
        graph = model.encode_state(before, control, nodes)
        predicted, joint = model.predict_joint(before.belief, graph)
        first = most_probable(ContactBelief(jnp.sum(joint, axis=1)))
        ratios = edge_log_ratios(model, graph, joint, observed, noise, first)
        return posterior_by_motion(predicted, joint, ratios)

    usable, own = both_finite(before, observed), getattr(model, "with_motion", None)
    corrected = own(carried, before, control, observed, nodes, noise) if own else by_edge()
    corrected = cast_like(corrected, carried)
    return jax.tree.map(lambda new, old: jnp.where(usable, new, old), corrected, carried)


def edge_log_ratios(
    model: ContactDynamics,
    graph: EncodedGraph,
    joint: Float[Array, "E K K"],
    observed: Motion,
    noise: MotionNoise,
    types: Float[Array, "E K"],
) -> Float[Array, "E K K"]:
    """Log-likelihood of the motion with each edge of type i first and of type j in the end.

    Each is less that without the edge. ``graph`` is of the state from which the step begins, and
    ``joint`` the probability of the pairs of types: `ContactDynamics.predict_joint`. One edge is
    judged after the other; those not judged yet have ``types``, one-hot. Edges that are farther
    than the nearest few, or beyond the cutoff, have 0.
    """

    bodies = graph.bodies
    apart = _begun_apart(model, graph, observed)

    def moved(types: Float[Array, "E K"]) -> Motion:
        return motion_given_types(
            model,
            bodies.position,
            bodies.velocity,
            graph.control,
            bodies.nodes,
            types,
            graph.contact_points,
        )

    edge_types = joint.shape[-1]
    if len(joint) == 0:  # a single body
        return jnp.zeros(joint.shape, graph.weight.dtype)

    def judge(
        types: Float[Array, "E K"], edge: Int[Array, ""]
    ) -> tuple[Float[Array, "E K"], Float[Array, "K K"]]:
        one_hot = jnp.eye(edge_types, dtype=types.dtype)
        motions = jax.vmap(lambda one: moved(types.at[edge].set(one)))(one_hot)
        ratios = noise.log_ratios(motions, observed, bodies.nodes.mask, model.dt, graph.edge_types)
        ratios = ratios - ratios[0, 0] + apart[edge]
        after = jnp.sum(pair_posterior(joint[edge], ratios), axis=0)
        return types.at[edge].set(one_hot[jnp.argmax(after)]), ratios

    # The nearest first, each given the result for those before it: a motion that one contact
    # explains is no evidence for another.
    edges = _nearest(graph)
    count = jnp.sum(graph.weight[edges] > _LEAST_WEIGHT)
    Carry = tuple[Int[Array, ""], Float[Array, "E K"], Float[Array, "E K K"]]

    def judge_next(carry: Carry) -> Carry:
        index, types, ratios = carry
        types, ratio = judge(types, edges[index])
        return index + 1, types, ratios.at[edges[index]].set(ratio.astype(ratios.dtype))

    first = jnp.zeros((), int), types, jnp.zeros(joint.shape, graph.weight.dtype)
    return jax.lax.while_loop(lambda carry: carry[0] < count, judge_next, first)[2]


def _begun_apart(
    model: ContactDynamics, graph: EncodedGraph, observed: Motion
) -> Float[Array, "E K K"]:
    """What the motion after the step says against contacts that begin in it: bodies that are apart
    then, and that do not come from each other, have not met, such as where another contact was in
    the way."""
    position, velocity = observed
    points = model.features.meeting(graph.bodies.nodes, position, graph.geometry.edge_index)
    back = geometry(points, velocity=-velocity, coasting=-velocity, dt=model.dt, contact_distance=0)
    nearest = back.closest_approach[: len(graph.weight)]
    near = model.prior(dataclasses.replace(graph.geometry, closest_approach=nearest))
    contact = np.array([False, *(each.contact for each in graph.edge_types)])
    # Squared, since its bound stands for forces that are not known.
    return jnp.where(np.outer(~contact, contact), 2.0 * jnp.log(near)[:, None, None], 0.0)


def motion_given_types(
    model: ContactDynamics,
    position: Float[Array, "N G"],
    velocity: Float[Array, "N G"],
    control: Float[Array, " U"],
    nodes: Nodes,
    types: Float[Array, "E K"],
    meeting: Meeting | None = None,
) -> Motion:
    """Where a step would lead under a control [N], if all its edges had these one-hot types;
    ``meeting`` as of `ContactDynamics.encode`.

    A network that knows the contact distance does not let an edge act beyond it, even one that is
    active with certainty; predictions with and without it would then be the same motion. So bodies
    touch here at their closest approach. The likelihood is that of the motion if the edge does act;
    how probable that is at its distance is part of the belief.
    """
    belief = ContactBelief(types, edge_types=model.inference.edge_types)
    graph = model.encode(position, velocity, control, nodes, belief, meeting, as_touching=True)
    return model.linearize(model.cut_edges(graph, belief))(position, velocity, control)


def most_probable(belief: ContactBelief) -> Float[Array, "E K"]:
    """The likeliest type of every edge, one-hot."""
    types = belief.type_probability
    return jax.nn.one_hot(likeliest_type(types), types.shape[-1], dtype=types.dtype)


def _nearest(graph: EncodedGraph) -> Int[Array, " considered"]:
    """The edges within the cutoff whose nodes come nearest to each other in the step."""
    near = jnp.where(graph.weight > 0, -graph.geometry.closest_approach, -jnp.inf)
    return jax.lax.top_k(near, min(_CONSIDERED, near.shape[0]))[1]
