"""Learning of the filter from the motion of judged trajectories: the second M-step.

It is scored along trajectories by -log(sum over pairs of types of p exp(l)), with p its belief
before a step and l the log ratios of the motion in it: the negative log-likelihood of a hidden
Markov model, which needs no labels and is proper, hence calibrates p.
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from contactgraph.bodies.graph import EncodedGraph
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.inference.contact_belief import (
    ContactBelief,
    ContactSensor,
    late_rate,
    posterior_by_motion,
)
from contactgraph.inference.features import stillness
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.step import ModelState
from contactgraph.train.motion_evidence import (
    MotionEvidence,
    encode_evidence,
    filter_steps,
    where_observed,
    without_gradient,
)
from contactgraph.train.objective import FitState, TrainConfig, TrainingData, descend, optimiser_of
from contactgraph.train.window_loss import masked_mean

_SMALLEST = 1e-6
PERIOD, _FILTER_STEPS = 25, 100
"""Steps of the dynamics on the same judged trajectories, and those of the filter that follow: it
learns from rare events, so it needs more steps, and each costs little."""
_FILTERED = 12
"""Judged trajectories on which the filter is scored a step."""
_LAPSE, _RESUME = 0.15, 0.1
"""Probability a step that observation stops, and that it begins again, in training of the filter:
it learns to predict for some 10 steps from a belief that motion has corrected."""
_APART = 0.1
"""Prior of contact, by the recorded distance, below which bodies certainly do not touch."""
_MOST_WRONG, _LATEST = 0.1, 3
"""Largest error rates, and longest delay [steps], of the sensors of training."""
_DENIAL = 0.1
"""Weight of `denial_score` in training."""
_DENIED, _UNMEASURED = 10, 0.5
"""Steps of `denial_score` that a sensor denies contact, and seconds without measurement after."""


def filter_optimiser(config: TrainConfig) -> optax.GradientTransformation:
    """Over all of the filter's steps, which begin in the second half of training."""
    steps = max(1, config.steps // (2 * PERIOD)) * _FILTER_STEPS
    return optimiser_of(config, steps=steps)


@eqx.filter_jit
def learn_filter(
    state: FitState,
    data: TrainingData,
    trajectories: TrajectoryBatch[Array],
    evidence: MotionEvidence,
    key: PRNGKeyArray,
) -> tuple[FitState, Float[Array, ""]]:
    """Steps of the filter alone, and their mean score."""
    config, (hide_key, key) = data.config, jax.random.split(key)
    model, (of_dynamics, of_filter) = state.model, state.optimiser
    observed = random_segments(hide_key, evidence.types.shape[:2])
    pool = predict_unobserved(model, trajectories, evidence, observed)
    params, static = eqx.partition(model.inference, eqx.is_inexact_array)

    def loss(params: PyTree, key: PRNGKeyArray) -> Float[Array, ""]:
        learned = replace(model, inference=eqx.combine(params, static))
        draw_key, key = jax.random.split(key)
        index = jax.random.randint(draw_key, (_FILTERED,), 0, len(observed))
        drawn, told, seen = jax.tree.map(lambda leaf: leaf[index], (*pool, observed))
        score = filter_loss(learned, drawn, told, seen, key, data.reports_touch, _DENIAL)
        return config.weights.likelihood * score

    def slope(params: PyTree, key: PRNGKeyArray) -> tuple[PyTree, Array]:
        score, gradient = jax.value_and_grad(loss)(params, key)
        return gradient, score

    keys = jax.random.split(key, _FILTER_STEPS)
    params, of_filter, score = descend(slope, filter_optimiser(config), params, of_filter, keys)
    learned = replace(model, inference=eqx.combine(params, static))
    return replace(state, model=learned, optimiser=(of_dynamics, of_filter)), score


def random_segments(key: PRNGKeyArray, shape: tuple[int, ...]) -> Bool[Array, "B T"]:
    """True in random segments of the steps, those after which the bodies are observed."""
    first_key, key = jax.random.split(key)
    first = jax.random.bernoulli(first_key, _RESUME / (_LAPSE + _RESUME), shape[:1])

    def step(on: Array, uniform: Array) -> tuple[Array, Array]:
        on = jnp.where(on, uniform >= _LAPSE, uniform < _RESUME)
        return on, on

    return jax.lax.scan(step, first, jax.random.uniform(key, shape[::-1]))[1].T


def predict_unobserved(
    model: ContactDynamics,
    trajectories: TrajectoryBatch[Array],
    evidence: MotionEvidence,
    observed: Bool[Array, "B T"],
) -> tuple[TrajectoryBatch[Array], MotionEvidence]:
    """The trajectories with predicted states after steps that are not ``observed``, and what the
    recorded motion says of their steps.

    Recorded states tell what the filter ought to predict: a body that is still beside the gripper
    was not let go. Along a rollout the states follow the likeliest types, so the filter is scored
    on such rollouts, by the recorded motion. Bodies that did not touch in it were free in that
    step, wherever the rollout has them.
    """
    model, trajectories = without_gradient(model), evidence.weighed(trajectories)
    touch = jnp.log(jnp.clip((1.0 - evidence.prior[..., 0]) / _APART, _SMALLEST, 1.0))

    def along(window: TrajectoryBatch[Array], ratio: Array, observed: Array) -> ModelState:
        def step(state: ModelState, inputs: tuple) -> tuple[ModelState, ModelState]:
            control, ratio, observed, after = inputs
            graph = model.encode_state(state, control, window.nodes)
            belief, joint = model.predict_joint(state.belief, graph)
            linear = model.linearize(model.cut_edges(graph, belief))
            predicted = *linear(state.position, state.velocity, control), belief
            corrected = *after, posterior_by_motion(belief, joint, ratio).observed
            position, velocity, belief = jax.tree.map(
                lambda one, other: jnp.where(observed, one, other), corrected, predicted
            )
            return ModelState(position, velocity, belief), state

        position, velocity = window.position[0], window.velocity[0]
        first = model.initial_belief(position, velocity, window.nodes)
        after = window.position[1:], window.velocity[1:]
        inputs = window.control, ratio, observed, after
        return jax.lax.scan(step, ModelState(position, velocity, first), inputs)[1]

    states = jax.vmap(along)(trajectories, evidence.log_ratio, observed)
    begins = jnp.pad(observed, ((0, 0), (1, 0)), constant_values=True)[:, :-1, None]
    ratio = evidence.log_ratio.at[..., 1:].add(jnp.where(begins, 0.0, touch)[..., None, None])
    replaced = trajectories._replace(
        position=trajectories.position.at[:, :-1].set(states.position),
        velocity=trajectories.velocity.at[:, :-1].set(states.velocity),
    )
    before = jnp.where(begins[..., None], evidence.before, states.belief.type_probability)
    return replaced, replace(evidence, before=before, log_ratio=ratio, meeting=None)


def filter_loss(
    model: ContactDynamics,
    trajectories: TrajectoryBatch[Array],
    evidence: MotionEvidence,
    observed: Bool[Array, "B T"],
    key: PRNGKeyArray,
    reports_touch: bool = True,
    denial: float = 0.0,
) -> Float[Array, ""]:
    """Mean score of every edge within the cutoff at every step; see the module's docstring.

    Motion corrects the belief in the states that are ``observed``. Where the trajectories have
    recorded contacts, so do reports of these, in segments of them: see `random_reports`. The score
    is that of the motion alone; ``denial`` times `denial_score` is added. Gradients reach the
    inference alone.
    """
    graph = encode_evidence(model, trajectories, evidence)
    reports: tuple = None, None
    if trajectories.contact is not None:
        used_key, report_key = jax.random.split(jax.random.fold_in(key, 1))
        used = observed & random_segments(used_key, observed.shape)
        reports = random_reports(trajectories.contact, report_key, used, reports_touch)
    filtered = jax.vmap(partial(filter_steps, model))(graph, evidence.log_ratio, observed, *reports)
    counted = (graph.weight > 0) & trajectories.step_mask[..., None]
    score = masked_mean(filtered.score, counted)
    return score + denial * denial_score(model, graph, key) if denial else score


def random_reports(
    contact: Float[Array, "B T+1 E"],
    key: PRNGKeyArray,
    used: Bool[Array, "B T"],
    reports_touch: bool = True,
) -> tuple[Float[Array, "B T E"], ContactSensor]:
    """Reports of recorded contacts about the state that each step leads to, NaN but in the steps
    ``used``, of a sensor a trajectory; and these sensors, as the correction assumes them.

    They have random error rates and delays.
    """
    false_key, miss_key, delay_key, error_key = jax.random.split(key, 4)
    count, states, _ = contact.shape
    false_alarm, miss = (
        jax.random.uniform(each, (count,), maxval=_MOST_WRONG) for each in (false_key, miss_key)
    )
    delay = jax.random.randint(delay_key, (count,), 0, _LATEST + 1)
    wrong = jnp.where(contact > 0.5, miss[:, None, None], false_alarm[:, None, None])
    is_wrong = jax.random.uniform(error_key, contact.shape) < wrong
    read = jnp.where(is_wrong, 1.0 - contact, contact)
    about = jnp.arange(1, states) - delay[:, None]
    known = used & (about >= 0)
    report = jnp.take_along_axis(read, jnp.maximum(about, 0)[..., None], axis=1)
    false_alarm, miss = (jnp.asarray(late_rate(rate, delay)) for rate in (false_alarm, miss))
    assumed = ContactSensor(false_alarm, miss, reports_touch)
    return jnp.where(known[..., None], report, jnp.nan), assumed


def denial_score(
    model: ContactDynamics, graph: EncodedGraph, key: PRNGKeyArray
) -> Float[Array, ""]:
    """Mean improbability of *free* where a sensor denies contact of bodies that touch at rest.

    Data hardly ever show that, so that their likelihood leaves open what the filter does then. For
    every edge a step is drawn in which its bodies touch and their distance does not change. That
    step is repeated: first the belief is corrected to *free* after each, then nothing is measured.
    The improbability is that of the transition from free to free; what comes from the other types
    is what the data tell.
    """
    still = jax.vmap(jax.vmap(lambda each: stillness(each.geometry)))(graph)
    touching = jax.lax.stop_gradient((1.0 - graph.prior[..., 0]) * still)  # [B, T, E]
    drawn = jax.random.categorical(key, jnp.log(touching + _SMALLEST), axis=1)

    def taken(values: Float[Array, "B T E V"]) -> Float[Array, "B E V"]:
        return jnp.take_along_axis(values, drawn[:, None, :, None], axis=1)[:, 0]

    embedding, prior, weight = map(taken, (graph.embedding, graph.prior, touching[..., None]))
    free = jnp.zeros_like(prior).at[..., 0].set(1.0)
    inference = model.inference
    # Contact is denied from the first, or after the prior made it likely; afterwards the bodies are
    # observed at rest, or predicted to be.
    at_once, seen = jax.random.bernoulli(jax.random.fold_in(key, 1), shape=(2, len(prior)))

    def step(belief: ContactBelief, denied: Array) -> tuple[ContactBelief, Array]:
        predicted, joint = jax.vmap(inference.predict)(belief, embedding, prior)
        types = predicted.type_probability
        stays = joint[..., 0, 0] / jnp.maximum(belief.type_probability[..., 0], _SMALLEST)
        score = -jnp.log(jnp.maximum(stays, _SMALLEST))
        after = replace(predicted, type_probability=jnp.where(denied, free, types))
        return jax.vmap(where_observed)(after, denied | seen), score

    believed = jnp.where(at_once[:, None, None], free, prior)
    first = jax.vmap(inference.init)(embedding, believed)
    denied = jnp.arange(_DENIED + round(_UNMEASURED / model.dt)) < _DENIED
    score = jnp.mean(jax.lax.scan(step, first, denied)[1][_DENIED // 3 :], axis=0)
    return jnp.sum(weight[..., 0] * score) / jnp.maximum(jnp.sum(weight), 1.0)
