r"""Contact without a sensor: likelihood of the observed motion with and without each edge.

For an edge e, the model predicts the last step twice, with the edge active and without it, all
others as is most probable; the evidence is how much better one fits the observation,

$$ \ell_e = \log p(x_{t+1} | x_t, u_t, e\ \text{active})
   - \log p(x_{t+1} | x_t, u_t, e\ \text{inactive}), $$

and the belief's log-odds become the predicted ones plus $\ell_e$. Where both predictions are
the same motion, $\ell_e = 0$, and the belief stays as predicted.

The prediction is the model's, from the belief before, with a memory: a contact that motion has
supported persists, as in a hidden Markov model, with the probability $e^{-dt/\tau}$ a step,
however improbable its distance makes it. Otherwise a model whose contact distance is a few
millimetres off would forget a contact as soon as nothing accelerates. Contacts without support by
motion are remembered by the model alone.
"""

from abc import abstractmethod
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.shapes import Meeting
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.model.contact_belief import (
    ContactBelief,
    cast_like,
    likeliest_type,
    pair_posterior,
    posterior_by_motion,
    without_change,
)
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.motion_noise import Motion, MotionNoise
from contactgraph.model.types import EncodedGraph, ModelState, Nodes

_CONSIDERED = 8
"""Edges considered in a step, nearest first: rarely do more bodies make contact at once, and the
cost of a control step must not grow with the square of the number of bodies."""
_MIN_PROBABILITY = 1e-6
_LEAST_WEIGHT = 0.5
"""Of the cutoff, from which an edge is considered: bodies far beyond contact have none."""


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


class TrajectoryModel(ContactDynamics):
    """A model whose edges last, so that all of a trajectory tells them and is learned from."""

    @abstractmethod
    def with_motion(
        self,
        carried: ContactBelief,
        before: ModelState,
        control: Float[Array, " U"],
        observed: Motion,
        nodes: Nodes,
        noise: MotionNoise,
    ) -> ContactBelief:
        """The belief after one more step."""

    @abstractmethod
    def trajectory_belief(self, trajectory: TrajectoryBatch[Array]) -> ContactBelief:
        """The belief after the motion of all steps of one trajectory."""

    @abstractmethod
    def trajectory_loss(self, trajectory: TrajectoryBatch[Array]) -> Float[Array, ""]:
        """What training minimises, of one trajectory, nat."""


def motion_noise(
    model: ContactDynamics, position: float = 0.0, velocity: float = 0.0
) -> MotionNoise:
    """The model's own noise where it has learned one, and that of observations, m and m/s."""
    learned = model.prediction_noise
    if learned is None:
        return MotionNoise(position, velocity)
    scales = learned.position, learned.velocity, learned.drift
    return MotionNoise(position, velocity, *scales, type_share=learned.share)


def check_motion_model(model: object) -> ContactDynamics:
    """The model, if motion can be judged by it; else raises `InvalidInputError`."""
    if not isinstance(model, ContactDynamics):
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
    usable = both_finite(before, observed)
    given = control, observed, nodes, noise
    if isinstance(model, TrajectoryModel):
        corrected, odds = model.with_motion(carried, before, *given), motion_log_odds
    else:
        evidence = contact_log_likelihood_ratio(model, before, motion_log_odds, *given)
        corrected, odds = evidence.corrected, evidence.motion_log_odds
    after = cast_like(corrected, carried), odds
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
    graph = model.encode_state(before, control, nodes)
    predicted, joint = model.predict_joint(before.belief, graph)
    stay = jnp.exp(-model.dt / noise.time_constant)
    if predicted.memory is None:  # else the inference itself remembers
        remembered = jnp.minimum(1.0 - jnp.exp(-motion_log_odds), before.belief.probability)
        predicted = _at_least(predicted, before.belief, stay * graph.weight * remembered)
        joint = without_change(predicted, noise.error_floor)
    ratios = edge_log_ratios(model, graph, joint, observed, noise)
    ratio = jnp.max(ratios[:, :, 1:], axis=(1, 2)).astype(motion_log_odds.dtype)
    return MotionEvidence(
        predicted=predicted,
        log_ratio=ratio,
        motion_log_odds=jnp.clip(stay * motion_log_odds + ratio, 0.0, noise.max_log_ratio),
        corrected=posterior_by_motion(predicted, joint, ratios),
    )


def edge_log_ratios(
    model: ContactDynamics,
    graph: EncodedGraph,
    joint: Float[Array, "E K K"],
    observed: Motion,
    noise: MotionNoise,
    types: Float[Array, "E K"] | None = None,
) -> Float[Array, "E K K"]:
    """Log-likelihood of the motion with each edge of type i first and of type j in the end.

    Each is less that without the edge. ``graph`` is of the state from which the step begins, and
    ``joint`` the probability of the pairs of types: `ContactDynamics.predict_joint`. One edge is
    judged after the other; those not judged yet have ``types``, where given, else the most probable
    ones. Edges that are farther than the nearest few, or beyond the cutoff, have 0.
    """
    noise = noise.at(graph.velocity, model.dt)
    step = graph.position, graph.velocity, graph.control, graph.nodes
    moved = partial(motion_given_types, model, *step, meeting=graph.meeting)
    edge_types = joint.shape[-1]
    if len(joint) == 0:  # a single body
        return jnp.zeros(joint.shape, graph.weight.dtype)

    def judge(
        types: Float[Array, "E K"], edge: Int[Array, ""]
    ) -> tuple[Float[Array, "E K"], Float[Array, "K K"]]:
        one_hot = jnp.eye(edge_types, dtype=types.dtype)
        motions = jax.vmap(lambda one: moved(types.at[edge].set(one)))(one_hot)
        ratios = noise.log_ratios(motions, observed, graph.nodes.mask, model.dt)
        ratios = ratios - ratios[0, 0]
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

    if types is None:
        types = most_probable(ContactBelief(jnp.sum(joint, axis=1)))
    first = jnp.zeros((), int), types, jnp.zeros(joint.shape, graph.weight.dtype)
    return jax.lax.while_loop(lambda carry: carry[0] < count, judge_next, first)[2]


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
    belief = ContactBelief(types)
    graph = model.encode(position, velocity, control, nodes, belief, meeting, as_touching=True)
    return model.linearize(model.cut_edges(graph, belief))(position, velocity, control)


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


def most_probable(belief: ContactBelief) -> Float[Array, "E K"]:
    """The likeliest type of every edge, one-hot."""
    types = belief.type_probability
    return jax.nn.one_hot(likeliest_type(types), types.shape[-1], dtype=types.dtype)


def _nearest(graph: EncodedGraph) -> Int[Array, " considered"]:
    """The edges within the cutoff whose nodes come nearest to each other in the step."""
    near = jnp.where(graph.weight > 0, -graph.geometry.closest_approach, -jnp.inf)
    return jax.lax.top_k(near, min(_CONSIDERED, near.shape[0]))[1]
