"""Losses of expectation maximisation: a filter by the likelihood of motion, dynamics by types.

The observed motion of a step says of every edge how likely it is with each pair of types, at the
start and in the end of the step: log ratios l, of which no gradient is taken. The filter is scored
along trajectories by -log(sum over pairs of p exp(l)), with p its belief before that step: the
negative log-likelihood of a hidden Markov model, which needs no labels and is proper, hence
calibrates p. The dynamics learn on short windows with the types that l of the very step makes
probable, so they do not pay for contacts that nothing could predict.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from contactgraph.bodies.graph import EncodedGraph
from contactgraph.data.dataset import Dataset
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import pair_indices
from contactgraph.inference.contact_belief import (
    ContactBelief,
    ContactSensor,
    correct,
    posterior_by_motion,
)
from contactgraph.inference.features import stillness
from contactgraph.inference.motion_noise import Motion
from contactgraph.model.body_mass import mass_score
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.batch import Window
from contactgraph.train.judged_steps import (
    JudgedSteps,
    SensorReports,
    random_reports,
    random_segments,
    seen_or_not,
    with_window_masses,
    without_gradient,
)
from contactgraph.train.loss import (
    LossTerms,
    WindowSteps,
    masked_mean,
    rollout_error,
)

_SMALLEST = 1e-6
DENIAL = 0.1
"""Weight in training of what sensors deny: see `filter_loss`."""
_DENIED, _UNMEASURED = 10, 0.5
"""Steps of `_denial_score` that a sensor denies contact, and seconds without measurement after."""


def check_contacts(model: ContactDynamics, dataset: Dataset, what: str) -> None:
    """Raises `InvalidInputError` where ``what`` lacks a filter, or any trajectory its contacts."""
    if model.prediction_noise is None:
        raise InvalidInputError(
            f"{what}: the model must be a filter (--model ours), found "
            f"{type(model.inference).__name__}"
        )
    lacking = sum(each.contact is None for each in dataset)
    if lacking:
        raise InvalidInputError(
            f"{what}: {lacking} of {len(dataset)} trajectories have no contact field; it must be "
            "in every trajectory"
        )


def dynamics_loss(
    model: ContactDynamics,
    windows: Window,
    judged: JudgedSteps,
    rolled_out: Bool[Array, " B"],
) -> LossTerms:
    """Terms over a batch of windows, given the likeliest types; the filter does not learn.

    Windows that are ``rolled_out`` are predicted from their first states, of the others each step
    from the recorded one.
    """
    position, velocity, in_reach = jax.vmap(partial(given_steps, model))(
        windows, judged.types, judged.before, rolled_out
    )
    after = windows.position[:, 1:], windows.velocity[:, 1:]
    error = jnp.sum(((position - after[0]) / model.dt) ** 2, axis=-1)
    error += jnp.sum((velocity - after[1]) ** 2, axis=-1)
    learned = jnp.broadcast_to(windows.learned[:, None], error.shape)
    single = learned & ~rolled_out[:, None, None]
    zero = noise = jnp.zeros(())
    if model.prediction_noise is not None:
        count = position.shape[2]
        incidence = np.any(pair_indices(count)[..., None] == np.arange(count), axis=1)
        score = model.prediction_noise.score(
            windows.velocity[:, :-1],
            jax.lax.stop_gradient((position, velocity)),
            judged.unhindered,
            after,
            jnp.einsum("en,blea->blna", incidence.astype(position.dtype), judged.types[..., 1:]),
            model.dt,
        )
        near = jnp.any(in_reach[..., None] & incidence, axis=2)
        noise = masked_mean(score, single & near)
    if judged.masses is not None:
        of_masses = jax.vmap(partial(mass_score, model))(judged.masses, windows.nodes)
        noise += masked_mean(of_masses, windows.nodes.passive)
    rollout = jax.vmap(partial(rollout_error, model))(position, velocity, windows)
    return LossTerms(
        prediction=masked_mean(jnp.sqrt(error + _SMALLEST), single),
        squared=masked_mean(error, single),
        rollout=masked_mean(rollout, learned & rolled_out[:, None, None]),
        prior=zero,
        likelihood=zero,
        noise=noise,
    )


def given_steps(
    model: ContactDynamics,
    window: Window,
    types: Float[Array, "L E K"],
    before: Float[Array, "L E K"],
    rolled_out: Bool[Array, ""],
) -> tuple[Float[Array, "L N G"], Float[Array, "L N G"], Bool[Array, "L E"]]:
    """The states, m and m/s, that the steps of a window lead to with these one-hot types in every
    step and ``before`` it, and the edges within the cutoff.

    Each step begins in the recorded state, or, where ``rolled_out``, where the last one led to.
    """

    def step(state: Motion, inputs: tuple) -> tuple[Motion, tuple[Array, Array, Array]]:
        recorded, control, types, before = inputs
        at: Motion = jax.tree.map(
            lambda own, seen: jnp.where(rolled_out, own, seen), state, recorded
        )
        believed = ContactBelief(before, edge_types=model.inference.edge_types)
        graph = model.encode(*at, control, window.nodes, believed)
        linear = model.linearize(model.cut_edges(graph, ContactBelief(types)))
        after = linear(*at, control)
        return after, (*after, graph.weight > 0)

    recorded = window.position[:-1], window.velocity[:-1]
    first = window.position[0], window.velocity[0]
    return jax.lax.scan(step, first, (recorded, window.control, types, before))[1]


def filter_loss(
    model: ContactDynamics,
    trajectories: Window,
    judged: JudgedSteps,
    step_mask: Bool[Array, "B T"],
    observed: Bool[Array, "B T"],
    key: PRNGKeyArray,
    contact: Float[Array, "B T+1 E"] | None = None,
    reports_touch: bool = True,
    denial: float = 0.0,
) -> Float[Array, ""]:
    """Mean score of every edge within the cutoff at every step; see the module's docstring.

    Motion corrects the belief in the states that are ``observed``. Where the recorded ``contact``
    is given, so do reports of it, in segments of these: see `random_reports`. The score is that of
    the motion alone; ``denial`` times the mean of `_denial_score` is added. Gradients reach the
    inference alone.
    """
    graph = encoded_steps(model, trajectories, judged)
    reports = None
    if contact is not None:
        used_key, report_key = jax.random.split(jax.random.fold_in(key, 1))
        used = observed & random_segments(used_key, step_mask.shape)
        reports = random_reports(contact, report_key, used)

    def along(
        graph: EncodedGraph, ratio: Array, corrects: Array, reports: SensorReports | None
    ) -> Array:
        return _filtered(model, graph, ratio, corrects, reports, reports_touch)[1]

    score = jax.vmap(along)(graph, judged.log_ratio, observed, reports)
    mean = masked_mean(score, (graph.weight > 0) & step_mask[..., None])
    if denial:
        mean = mean + denial * _denial_score(model, graph, key)
    return mean


def _denial_score(
    model: ContactDynamics, graph: EncodedGraph, key: PRNGKeyArray
) -> Float[Array, ""]:
    """Mean improbability of *free* where a sensor denies contact of bodies that touch at rest.

    Data hardly ever show that, so that their likelihood leaves open what the filter does then. For
    every edge a step is drawn in which its bodies touch and their distance does not change. That
    step is repeated: first the belief is corrected to *free* after each, then nothing is measured.
    The improbability is that of the transition from free to free; what comes from the other types
    is what the data tell.
    """
    still = stillness(graph.geometry)
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
        after = dataclasses.replace(predicted, type_probability=jnp.where(denied, free, types))
        return jax.vmap(seen_or_not)(after, denied | seen), score

    believed = jnp.where(at_once[:, None, None], free, prior)
    first = jax.vmap(inference.init)(embedding, believed)
    denied = jnp.arange(_DENIED + round(_UNMEASURED / model.dt)) < _DENIED
    score = jnp.mean(jax.lax.scan(step, first, denied)[1][_DENIED // 3 :], axis=0)
    return jnp.sum(weight[..., 0] * score) / jnp.maximum(jnp.sum(weight), 1.0)


def encoded_steps(model: ContactDynamics, windows: Window, judged: JudgedSteps) -> EncodedGraph:
    """[B, L, ...] the steps' graphs, with gradients of the inference alone."""
    learned = dataclasses.replace(without_gradient(model), inference=model.inference)
    before = ContactBelief(judged.before, edge_types=model.inference.edge_types)
    return WindowSteps(learned, windows, 1).encode(before, judged.meeting)


def predict_and_score(
    model: ContactDynamics,
    belief: ContactBelief,
    graph: EncodedGraph,
    ratio: Float[Array, "E K K"],
) -> tuple[ContactBelief, Float[Array, "E K K"], Float[Array, " E"]]:
    """`ContactDynamics.predict_joint`, and the negative log-likelihood of each edge's motion."""
    predicted, joint = model.predict_joint(belief, graph)
    score = -jax.nn.logsumexp(jnp.log(jnp.maximum(joint, _SMALLEST)) + ratio, axis=(1, 2))
    return predicted, joint, score


def _filtered(
    model: ContactDynamics,
    graph: EncodedGraph,
    ratio: Float[Array, "T E K K"],
    corrects: Bool[Array, " T"],
    reports: SensorReports | None = None,
    reports_touch: bool = True,
) -> tuple[ContactBelief, Float[Array, "T E"]]:
    """The corrected belief [T, ...] after every step of a trajectory, and the step's score."""

    def step(belief: ContactBelief, inputs: tuple) -> tuple[ContactBelief, tuple]:
        graph, ratio, corrects, report = inputs
        predicted, joint, score = predict_and_score(model, belief, graph, ratio)
        used = jnp.where(corrects, ratio, 0.0)
        posterior = posterior_by_motion(predicted, joint, used)
        if reports is not None:
            sensor = ContactSensor(reports.false_alarm, reports.miss, reports_touch)
            posterior = correct(posterior, report, sensor)
        after = seen_or_not(posterior, corrects)
        return after, (after, score)

    first = model.prior_belief(jax.tree.map(lambda leaf: leaf[0], graph))
    report = None if reports is None else reports.report
    beliefs, score = jax.lax.scan(step, first, (graph, ratio, corrects, report))[1]
    return beliefs, score


def corrected_beliefs(
    model: ContactDynamics, trajectories: Window, judged: JudgedSteps
) -> ContactBelief:
    """[B, T, ...] the beliefs after every step, corrected by the motion of all up to it."""
    trajectories = with_window_masses(trajectories, judged.masses)
    graph = encoded_steps(model, trajectories, judged)
    always = jnp.ones(trajectories.control.shape[1], bool)
    return jax.vmap(lambda graph, ratio: _filtered(model, graph, ratio, always)[0])(
        graph, judged.log_ratio
    )
