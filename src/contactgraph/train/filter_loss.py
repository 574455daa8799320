"""Losses of expectation maximisation: a filter by the likelihood of motion, dynamics by types.

The observed motion of a step says of every edge how much likelier it is with each of its types than
without it: log ratios l, of which no gradient is taken. The filter is scored along trajectories by
-log(sum over types of p exp(l)), with p its belief before that step: the negative log-likelihood of
a hidden Markov model, which needs no labels and is proper, hence calibrates p. The dynamics learn
on short windows with the types that l of the very step makes probable, so they do not pay for
contacts that nothing could predict.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from contactgraph.model.contact_belief import ContactBelief, ContactSensor, correct
from contactgraph.model.contact_dynamics import ContactDynamics, EncodedGraph
from contactgraph.model.motion_likelihood import (
    MotionNoise,
    edge_log_ratios,
    most_probable,
    motion_noise,
    posterior_by_motion,
)
from contactgraph.model.types import LinearDynamics, ModelState
from contactgraph.train.batch import Window
from contactgraph.train.contact_reports import SensorReports, random_reports
from contactgraph.train.loss import (
    LossTerms,
    WindowSteps,
    masked_mean,
    rollout_error,
    squared_state_error,
)

_SMALLEST = 1e-6
_ERROR_FLOOR = MotionNoise().error_floor
_LAPSE, _RESUME = 0.05, 0.1
"""Probability a step that corrections stop, and that they begin again, in training of the filter:
it learns to keep a belief for some 10 steps without evidence."""
DENIAL = 0.1
"""Weight in training of what sensors deny: see `filter_loss`."""
_DENIED, _UNMEASURED = 6, 10
"""Steps of `_denial_score` that a sensor denies contact, and without measurement afterwards."""
_STILL = 0.02
"""Change of distance in a step, in contact distances, of bodies at rest with each other."""


def _without_gradient(model: ContactDynamics) -> ContactDynamics:
    arrays, others = eqx.partition(model, eqx.is_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), others)


def judged_steps(
    model: ContactDynamics, windows: Window, devices: int = 1
) -> tuple[WindowSteps, EncodedGraph, Float[Array, "B L E K"]]:
    """The encoded steps of all windows, and the log ratio of every edge by each step's motion."""
    fixed = jax.lax.stop_gradient
    steps = WindowSteps(model, windows, devices)
    frozen = _without_gradient(model)
    plain = WindowSteps(frozen, windows, devices)

    def sensitivity(graph: EncodedGraph) -> Array:
        belief = frozen.prior_belief(graph)
        return frozen.linearize(frozen.cut_edges(graph, belief)).control_sensitivity

    found = plain.each(sensitivity, plain.encode(None))
    displacement = steps.displacement(found)
    graph = steps.encode(displacement)

    noise = motion_noise(frozen)

    def judge(graph: EncodedGraph, displacement: Array, control: Array, after: tuple) -> Array:
        predicted = frozen.prior_belief(graph)
        state = ModelState(graph.position, graph.velocity, predicted, displacement)
        return edge_log_ratios(frozen, graph, state, predicted, control, after, noise)

    ratio = steps.each(judge, fixed(graph), displacement, windows.control, steps.after)
    return steps, graph, fixed(ratio)


def dynamics_loss(
    model: ContactDynamics, windows: Window, with_rollout: bool, devices: int = 1
) -> LossTerms:
    """One-step terms, or the rollout term, over a batch of windows, given their likeliest types."""
    steps, graph, ratio = judged_steps(model, windows, devices)

    def likeliest(graph: EncodedGraph, ratio: Array) -> Array:
        prior = model.prior_belief(graph)
        return most_probable(posterior_by_motion(prior, ratio, _ERROR_FLOOR))

    fixed = jax.lax.stop_gradient
    types = fixed(jax.vmap(jax.vmap(likeliest))(graph, ratio))
    zero = jnp.zeros(())
    if with_rollout:
        return LossTerms(zero, zero, _given_rollout(model, windows, types), zero, zero)

    def linear(graph: EncodedGraph, types: Array) -> LinearDynamics:
        return model.linearize(model.cut_edges(graph, ContactBelief(types)))

    def squared_error(
        graph: EncodedGraph, types: Array, control: Array, after: tuple
    ) -> tuple[Array, Array]:
        dynamics = linear(graph, types)
        error = squared_state_error(model, dynamics, graph, control, after)
        predicted = dynamics(graph.position, graph.velocity, control)
        score = jnp.zeros(())
        if model.prediction_noise is not None:
            score = model.prediction_noise.score(fixed(predicted), after)
        return error, jnp.where(near_edges(graph), score, jnp.nan)

    error, score = steps.each(squared_error, graph, types, windows.control, steps.after)
    nodes = jnp.broadcast_to(windows.learned[:, None], error.shape)
    prediction = masked_mean(jnp.sqrt(error + _SMALLEST), nodes)
    noise = masked_mean(score, nodes & jnp.isfinite(score))
    return LossTerms(prediction, masked_mean(error, nodes), zero, zero, zero, noise)


def near_edges(graph: EncodedGraph) -> Bool[Array, " N"]:
    """The nodes with an edge within the cutoff, whose motion is evidence."""
    exists = (graph.weight > 0).astype(graph.position.dtype)
    return jnp.einsum("sen,e->n", graph.geometry.incidence(len(graph.position)), exists) > 0


def _given_rollout(
    model: ContactDynamics, windows: Window, types: Float[Array, "B L E K"]
) -> Float[Array, ""]:
    """`LossTerms.rollout` when the types of every step are given."""

    def error(window: Window, types: Float[Array, "L E K"]) -> Float[Array, "L N"]:
        def linear(x: Array, v: Array, types: Array, displacement: Array | None) -> LinearDynamics:
            # The types are given, so that no inference needs the commands.
            graph = model.encode(x, v, window.nodes, displacement)
            return model.linearize(model.cut_edges(graph, ContactBelief(types)))

        def step(carry: tuple, inputs: tuple) -> tuple[tuple, tuple]:
            x, v, sensitivity = carry
            control, types = inputs
            displacement = jnp.sum(sensitivity * control, axis=-1)
            found = linear(x, v, types, jax.lax.stop_gradient(displacement))
            x, v = found(x, v, control)
            return (x, v, found.control_sensitivity), (x, v)

        x, v = window.position[0], window.velocity[0]
        first = linear(x, v, types[0], None).control_sensitivity
        _, states = jax.lax.scan(step, (x, v, first), (window.control, types))
        return rollout_error(model, states[0], states[1], window)

    found = jax.vmap(error)(windows, types)
    return masked_mean(found, jnp.broadcast_to(windows.learned[:, None], found.shape))


def filter_loss(
    model: ContactDynamics,
    trajectories: Window,
    step_mask: Bool[Array, "B T"],
    key: PRNGKeyArray,
    contact: Float[Array, "B T+1 E"] | None = None,
    reports_touch: bool = True,
    denial: float = 0.0,
) -> Float[Array, ""]:
    """Mean score of every edge within the cutoff at every step; see the module's docstring.

    ``denial`` times the mean of `_denial_score` is added.

    Motion corrects the belief in random segments of steps. Where the recorded ``contact`` is given,
    so do reports of it, in segments of their own: see `random_reports`. The score is that of the
    motion alone.
    """
    graph, ratio = _filter_inputs(model, trajectories)
    corrects = _correcting(key, step_mask.shape)
    reports = None
    if contact is not None:
        used_key, key = jax.random.split(jax.random.fold_in(key, 1))
        reports = random_reports(contact, key, _correcting(used_key, step_mask.shape))

    def along(
        graph: EncodedGraph, ratio: Array, corrects: Array, reports: SensorReports | None
    ) -> Array:
        return _filtered(model, graph, ratio, corrects, reports, reports_touch)[1]

    score = jax.vmap(along)(graph, ratio, corrects, reports)
    mean = masked_mean(score, (graph.weight > 0) & step_mask[..., None])
    if denial:
        mean = mean + denial * _denial_score(model, graph, jax.random.fold_in(key, 2))
    return mean


def _denial_score(
    model: ContactDynamics, graph: EncodedGraph, key: PRNGKeyArray
) -> Float[Array, ""]:
    """Mean improbability of *free* where a sensor denies contact of bodies that touch at rest.

    Data hardly ever show that, so that their likelihood leaves open what the filter does then. For
    every edge a step is drawn in which its bodies touch and their distance does not change. That
    step is repeated: first the belief is corrected to *free* after each, then nothing is measured.
    """
    moves = graph.geometry.distance - graph.geometry.closest_approach
    still = jnp.exp(-((moves / (_STILL * model.features.contact_distance)) ** 2))
    touching = jax.lax.stop_gradient((1.0 - graph.prior[..., 0]) * still)  # [B, T, E]
    drawn = jax.random.categorical(key, jnp.log(touching + _SMALLEST), axis=1)

    def taken(values: Float[Array, "B T E V"]) -> Float[Array, "B E V"]:
        return jnp.take_along_axis(values, drawn[:, None, :, None], axis=1)[:, 0]

    embedding, prior, weight = map(taken, (graph.embedding, graph.prior, touching[..., None]))
    free = jnp.zeros_like(prior).at[..., 0].set(1.0)
    size = getattr(model.inference, "memory_size", 0)

    def step(belief: ContactBelief, denied: Array) -> tuple[ContactBelief, Array]:
        predicted = jax.vmap(model.inference.predict)(belief, embedding, prior)
        types = predicted.type_probability
        score = -jnp.log(jnp.maximum(types[..., 0], _SMALLEST))
        return ContactBelief(jnp.where(denied, free, types), None, predicted.memory), score

    first = ContactBelief(prior, None, jnp.zeros((*prior.shape[:-1], size), prior.dtype))
    denied = jnp.arange(_DENIED + _UNMEASURED) < _DENIED
    score = jnp.mean(jax.lax.scan(step, first, denied)[1][_DENIED // 2 :], axis=0)
    return jnp.sum(weight[..., 0] * score) / jnp.maximum(jnp.sum(weight), 1.0)


def _filter_inputs(
    model: ContactDynamics, windows: Window
) -> tuple[EncodedGraph, Float[Array, "B L E K"]]:
    """As `judged_steps`; gradients reach the inference alone."""
    learned = dataclasses.replace(_without_gradient(model), inference=model.inference)
    return judged_steps(learned, windows)[1:]


def _correcting(key: PRNGKeyArray, shape: tuple[int, ...]) -> Bool[Array, "B T"]:
    """Random segments of steps after which motion corrects the belief."""
    first_key, key = jax.random.split(key)
    first = jax.random.bernoulli(first_key, _RESUME / (_LAPSE + _RESUME), shape[:1])

    def step(on: Array, uniform: Array) -> tuple[Array, Array]:
        on = jnp.where(on, uniform >= _LAPSE, uniform < _RESUME)
        return on, on

    return jax.lax.scan(step, first, jax.random.uniform(key, shape[::-1]))[1].T


def _filtered(
    model: ContactDynamics,
    graph: EncodedGraph,
    ratio: Float[Array, "T E K"],
    corrects: Bool[Array, " T"],
    reports: SensorReports | None = None,
    reports_touch: bool = True,
) -> tuple[ContactBelief, Float[Array, "T E"]]:
    """The last corrected belief of a trajectory, and the score of every step."""

    def step(belief: ContactBelief, inputs: tuple) -> tuple[ContactBelief, Array]:
        graph, ratio, corrects, report = inputs
        predicted = model.predict_belief(belief, graph)
        p = jnp.maximum(predicted.type_probability, _SMALLEST)
        score = -jax.nn.logsumexp(jnp.log(p) + ratio, axis=-1)
        used = jnp.where(corrects, ratio, 0.0)
        posterior = posterior_by_motion(predicted, used, _ERROR_FLOOR)
        if reports is not None:
            sensor = ContactSensor(reports.false_alarm, reports.miss, reports_touch)
            posterior = correct(posterior, report, sensor)
        return posterior, score

    first = model.prior_belief(jax.tree.map(lambda leaf: leaf[0], graph))
    report = None if reports is None else reports.report
    return jax.lax.scan(step, first, (graph, ratio, corrects, report))


def corrected_beliefs(model: ContactDynamics, windows: Window) -> ContactBelief:
    """The beliefs in the last states of windows, corrected by the motion of every step."""
    graph, ratio = _filter_inputs(model, windows)
    always = jnp.ones(ratio.shape[1], bool)
    return jax.vmap(lambda graph, ratio: _filtered(model, graph, ratio, always)[0])(graph, ratio)
