r"""Contact without a sensor: likelihood of the observed motion with and without each edge.

For an edge e, the model predicts the last step twice, with the edge active and without it, all
others as is most probable; the evidence is how much better one fits the observation,

.. math:: \ell_e = \log p(x_{t+1} | x_t, u_t, e\ \text{active})
    - \log p(x_{t+1} | x_t, u_t, e\ \text{inactive}),

and the belief's log-odds become the predicted ones plus :math:`\ell_e`. Where both predictions are
the same motion, :math:`\ell_e = 0`, and the belief stays as predicted.

The prediction is the model's, from the belief before, with a memory: a contact that motion has
supported persists, as in a hidden Markov model, with the probability :math:`e^{-dt/\tau}` a step,
however improbable its distance makes it. Otherwise a model whose contact distance is a few
millimetres off would forget a contact as soon as nothing accelerates. Contacts without support by
motion are remembered by the model alone.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.data.errors import InvalidInputError
from contactgraph.model.contact_belief import ContactBelief, cast_like
from contactgraph.model.contact_dynamics import ContactDynamics, EncodedGraph
from contactgraph.model.motion_noise import Motion, MotionNoise
from contactgraph.model.rollout import control_sensitivity, with_control_displacement
from contactgraph.model.types import ModelState, Nodes

_CONSIDERED = 8
"""Edges considered in a step, nearest first: rarely do more bodies make contact at once, and the
cost of a control step must not grow with the square of the number of bodies."""
_TOUCHING = 1.02
"""Contact distance of an edge assumed active, in units of its distance: clearly touching."""
_MIN_PROBABILITY = 1e-6


class MotionEvidence(eqx.Module):
    """Evidence of one observed step about every edge."""

    predicted: ContactBelief
    """[E, K] about the step, from the belief before it and the control applied in it."""
    log_ratio: Float[Array, " E"]
    """Log-likelihood of the motion with the edge active less that without; 0: no evidence."""
    motion_log_odds: Float[Array, " E"]
    """Log-odds, at least 0, of contact by the motion of recent steps: the filter's memory."""
    corrected: ContactBelief
    """[E, K] by `log_ratio`; bit for bit as predicted where that is 0."""


def motion_noise(
    model: ContactDynamics, position: float = 0.0, velocity: float = 0.0
) -> MotionNoise:
    """The model's own noise where it has learned one, and that of observations, m and m/s."""
    learned = model.prediction_noise
    if learned is None:
        return MotionNoise(position, velocity)
    return MotionNoise(position, velocity, learned.position, learned.velocity)


def check_motion_model(model: object) -> ContactDynamics:
    """The model, if motion can be judged by it; else raises `InvalidInputError`."""
    if not isinstance(model, ContactDynamics):
        raise InvalidInputError(
            "motion_noise: the model must be a ContactDynamics, which predicts the motion with and "
            f"without each contact, found {type(model).__name__}"
        )
    if model.neighbor_list is not None:
        raise InvalidInputError(
            "motion_noise: the log-odds by motion are kept for all pairs, so the model must have "
            "no neighbor list (neighbor_list=None)"
        )
    return model


def correct_by_motion(
    model: ContactDynamics,
    carried: ContactBelief,
    before: ModelState,
    motion_log_odds: Float[Array, " E"],
    control: Float[Array, " U"],
    observed: Motion,
    nodes: Nodes,
    noise: MotionNoise,
) -> tuple[ContactBelief, Float[Array, " E"]]:
    """The corrected belief about the last step, and `MotionEvidence.motion_log_odds`.

    Both stay as ``carried`` and ``motion_log_odds`` where one of the step's two observations is not
    finite: the first of a trajectory has none before it, and a bad one is no evidence for either of
    its steps.
    """
    evidence = contact_log_likelihood_ratio(
        model, before, motion_log_odds, control, observed, nodes, noise
    )
    arrays = (before.position, before.velocity, *observed)
    usable = jnp.all(jnp.stack([jnp.all(jnp.isfinite(one)) for one in arrays]))
    after = cast_like(evidence.corrected, carried), evidence.motion_log_odds
    unchanged = carried, motion_log_odds
    return jax.tree.map(lambda new, old: jnp.where(usable, new, old), after, unchanged)


def contact_log_likelihood_ratio(
    model: ContactDynamics,
    before: ModelState,
    motion_log_odds: Float[Array, " E"],
    control: Float[Array, " U"],
    observed: Motion,
    nodes: Nodes,
    noise: MotionNoise,
) -> MotionEvidence:
    """Evidence of the step from ``before`` under the applied ``control`` [N] to ``observed``.

    ``before.belief`` is about the step that led to ``before``, corrected by all that was known
    then; ``motion_log_odds`` are of that step, too (zeros: no evidence by motion yet).
    """
    sensitivity = control_sensitivity(model, before, nodes)
    state = with_control_displacement(before, sensitivity, control)
    graph = model.encode_state(state, nodes)
    predicted = model.predict_belief(state.belief, graph)
    stay = jnp.exp(-model.dt / noise.time_constant)
    if predicted.memory is None:  # else the inference itself remembers
        remembered = jnp.minimum(1.0 - jnp.exp(-motion_log_odds), before.belief.probability)
        predicted = _at_least(predicted, before.belief, stay * graph.weight * remembered)
    ratios = edge_log_ratios(model, graph, state, predicted, control, observed, noise)
    ratio = jnp.max(ratios[:, 1:], axis=-1).astype(motion_log_odds.dtype)
    return MotionEvidence(
        predicted=predicted,
        log_ratio=ratio,
        motion_log_odds=jnp.clip(stay * motion_log_odds + ratio, 0.0, noise.max_log_ratio),
        corrected=posterior_by_motion(predicted, ratios, noise.error_floor),
    )


def edge_log_ratios(
    model: ContactDynamics,
    graph: EncodedGraph,
    state: ModelState,
    predicted: ContactBelief,
    control: Float[Array, " U"],
    observed: Motion,
    noise: MotionNoise,
) -> Float[Array, "E K"]:
    """Log-likelihood of the motion in a step with each edge of each type less that without it.

    ``graph`` is of ``state``, from which the step begins; ``predicted`` is about the step. Edges
    that are farther than the nearest few, or beyond the cutoff, have 0.
    """
    touching = _as_if_touching(model, state, graph)

    def moved(types: Float[Array, "E K"]) -> Motion:
        linear = model.linearize(model.cut_edges(touching, ContactBelief(types)))
        return linear(state.position, state.velocity, control)

    Carry = tuple[Float[Array, "E K"], Motion]
    edge_types = predicted.edge_types

    def judge(carry: Carry, edge: Int[Array, ""]) -> tuple[Carry, Float[Array, " K"]]:
        types, motion = carry
        others = (jnp.argmax(types[edge]) + jnp.arange(1, edge_types)) % edge_types
        other_types = jax.vmap(
            lambda other: types.at[edge].set(jax.nn.one_hot(other, edge_types, dtype=types.dtype))
        )(others)
        other_motions = jax.vmap(moved)(other_types)

        motions = jax.tree.map(
            lambda one, rest: (
                jnp.zeros((edge_types, *one.shape), one.dtype)
                .at[jnp.argmax(types[edge])]
                .set(one)
                .at[others]
                .set(rest)
            ),
            motion,
            other_motions,
        )
        ratios = noise.log_ratios(motions, observed, graph.nodes.mask, model.dt)
        # An edge beyond the cutoff is inactive with certainty, whatever moves.
        ratios = jnp.where(graph.weight[edge] > 0, ratios - ratios[0], 0.0)
        after = _posterior(predicted.type_probability[edge], ratios, noise.error_floor)
        matches = others == jnp.argmax(after)
        chosen = jax.tree.map(
            lambda new, old: jnp.where(jnp.any(matches), new[jnp.argmax(matches)], old),
            (other_types, other_motions),
            carry,
        )
        return chosen, ratios

    # The nearest first, each given the result for those before it: a motion that one contact
    # explains is no evidence for another.
    edges = _nearest(graph)
    probable = most_probable(predicted)
    ratios = jax.lax.scan(judge, (probable, moved(probable)), edges)[1]
    none = jnp.zeros((*graph.weight.shape, edge_types), graph.weight.dtype)
    return none.at[edges].set(ratios.astype(none.dtype))


def posterior_by_motion(
    predicted: ContactBelief, log_ratios: Float[Array, "E K"], error_floor: float
) -> ContactBelief:
    """The belief corrected by `edge_log_ratios`; bit for bit as predicted where these are 0."""
    types = predicted.type_probability
    after = jax.vmap(_posterior, in_axes=(0, 0, None))(types, log_ratios, error_floor)
    after = jnp.where(jnp.any(log_ratios != 0, axis=-1, keepdims=True), after, types)
    return ContactBelief(after, predicted.edge_id, predicted.memory)


def _posterior(
    types: Float[Array, " K"], log_ratios: Float[Array, " K"], error_floor: float
) -> Float[Array, " K"]:
    """Bayes' rule on an edge. A type that motion favours counts as no less probable than
    ``error_floor``, because networks are overconfident outside of their training data."""
    favoured = jax.nn.one_hot(jnp.argmax(log_ratios), len(types), dtype=types.dtype)
    believed = jnp.sum(favoured * types)
    raised = jnp.maximum(believed, error_floor)
    others = (1.0 - raised) / jnp.maximum(1.0 - believed, _MIN_PROBABILITY) * types
    prior = jnp.where(favoured > 0, raised, others)
    return jax.nn.softmax(jnp.log(jnp.maximum(prior, _MIN_PROBABILITY)) + log_ratios)


def _at_least(
    predicted: ContactBelief, before: ContactBelief, least: Float[Array, " E"]
) -> ContactBelief:
    """The prediction, with every edge active at least with the probability ``least``, of the types
    it had before."""
    types = jnp.maximum(before.type_probability[:, 1:], _MIN_PROBABILITY)
    kept = least[:, None] * types / jnp.sum(types, axis=-1, keepdims=True)
    active = predicted.type_probability[:, 1:]
    active = jnp.where(jnp.sum(active, axis=-1, keepdims=True) < least[:, None], kept, active)
    inactive = 1.0 - jnp.sum(active, axis=-1, keepdims=True)
    return ContactBelief(jnp.concatenate([inactive, active], axis=-1))


def _as_if_touching(model: ContactDynamics, state: ModelState, graph: EncodedGraph) -> EncodedGraph:
    """The same step as if bodies touched at their closest approach.

    A network that knows the contact distance does not let an edge act beyond it, even one that is
    active with certainty; both predictions would then be the same motion. The likelihood is that of
    the motion if the edge does act; how probable that is at its distance is part of the belief.
    """
    nearest = _TOUCHING * graph.geometry.closest_approach
    touch = jnp.maximum(model.features.contact_distance, nearest)
    return model.encode_state(state, graph.nodes, touch)


def most_probable(belief: ContactBelief) -> Float[Array, "E K"]:
    """The likeliest type of every edge, one-hot."""
    types = belief.type_probability
    return jax.nn.one_hot(jnp.argmax(types, axis=-1), types.shape[-1], dtype=types.dtype)


def _nearest(graph: EncodedGraph) -> Int[Array, " considered"]:
    """The edges within the cutoff whose nodes come nearest to each other in the step."""
    near = jnp.where(graph.weight > 0, -graph.geometry.closest_approach, -jnp.inf)
    return jax.lax.top_k(near, min(_CONSIDERED, near.shape[0]))[1]
