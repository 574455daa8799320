"""Evidence of recorded steps: the likelihood of their motion, and contacts as sensors report."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from contactgraph.bodies.graph import EdgeType, EncodedGraph, first_where
from contactgraph.bodies.shapes import Meeting
from contactgraph.inference.contact_belief import (
    ContactBelief,
    late_rate,
    posterior_by_motion,
    without_change,
)
from contactgraph.inference.motion_noise import Motion
from contactgraph.model.body_mass import MassBelief, first_masses, trajectory_masses, with_masses
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.motion_likelihood import edge_log_ratios, motion_noise
from contactgraph.model.step import ModelState
from contactgraph.train.batch import WholeTrajectories, Window, draw_by
from contactgraph.train.loss import WindowSteps

_FILTERED = 12
"""Judged trajectories on which the filter is scored a step."""
_LAPSE, _RESUME = 0.15, 0.1
"""Probability a step that observation stops, and that it begins again, in training of the filter:
it learns to predict for some 10 steps from a belief that motion has corrected."""
_APART = 0.1
"""Prior of contact, by the recorded distance, below which bodies certainly do not touch."""
_LEAST = 1e-6
_CHANGE = 0.1
"""Probability a step that a hold begins or ends, where geometry does not tell."""
_MOST_WRONG, _LATEST = 0.1, 3
"""Largest error rates, and longest delay [steps], of the sensors of training."""


class JudgedSteps(eqx.Module):
    """What the motion of every step of a batch of windows says, without gradient."""

    before: Float[Array, "B L E K"]
    """`types` of the step before each step, or likely ones."""
    log_ratio: Float[Array, "B L E K K"]
    """`edge_log_ratios`."""
    prior: Float[Array, "B L E K"]
    """`EncodedGraph.prior` where nothing is held."""
    types: Float[Array, "B L E K"]
    """The likeliest type of each edge in each step, one-hot."""
    unhindered: Motion
    """[B, L, N, D] m and m/s; where each step would lead without edges."""
    meeting: Meeting | None
    """[B, L, ...] `EncodedGraph.meeting`. None: to be found again."""
    masses: MassBelief | None = None
    """[B, N] by the motion of all steps. None: bodies of a type weigh alike."""


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
    types, hold = prior.type_probability, first_where(each.holds for each in prior.edge_types)
    index = jnp.where(types[..., 0] < 0.5, hold, 0)
    return jax.nn.one_hot(index, types.shape[-1], dtype=types.dtype)


def likeliest_types(
    prior: Float[Array, "L E K"],
    log_ratio: Float[Array, "L E K K"],
    edge_types: tuple[EdgeType, ...],
) -> Float[Array, "L E K"]:
    """One-hot types of every edge in the steps of a window, each by the motion of all the steps.

    One step often leaves open whether a body is held, those around it do not. Forward and backward
    recursions of a hidden Markov model (Rabiner 1989, section III) whose touches come and go with
    the geometry and whose other types last.
    """
    types = prior.shape[-1]
    last = np.array([False, *(not each.unilateral for each in edge_types)])
    begins = prior * jnp.where(last, _CHANGE, 1.0)
    begins = begins / jnp.sum(begins, axis=-1, keepdims=True)
    lasts = (1.0 - _CHANGE) * jnp.eye(types) + _CHANGE * prior[..., None, :]
    change = jnp.where(last[:, None], lasts, begins[..., None, :])
    pairs = jnp.log(jnp.maximum(change, _LEAST)) + log_ratio

    def forward(before: Array, pair: Array) -> tuple[Array, Array]:
        after = jax.nn.logsumexp(before[:, :, None] + pair, axis=1)
        return after, after

    def backward(after: Array, pair: Array) -> tuple[Array, Array]:
        return jax.nn.logsumexp(pair + after[:, None, :], axis=2), after

    past = jax.lax.scan(forward, jnp.log(jnp.maximum(prior[0], _LEAST)), pairs)[1]
    future = jax.lax.scan(backward, jnp.zeros_like(prior[0]), pairs, reverse=True)[1]
    return jax.nn.one_hot(jnp.argmax(past + future, axis=-1), types, dtype=prior.dtype)


def judge_steps(model: ContactDynamics, windows: Window, devices: int = 1) -> JudgedSteps:
    """The likelihood of the recorded motion of every step.

    Where masses differ within a type, contacts are judged with the usual masses, then the motion
    with these contacts tells each body's own mass, with which contacts are judged again.
    """
    model = without_gradient(model)
    first, noise = jax.vmap(partial(first_masses, model))(windows.nodes), motion_noise(model)
    if first is None:
        return _judge_steps(model, windows, devices)

    def weigh(window: Window, types: Array, first: MassBelief) -> MassBelief:
        states = window.position, window.velocity
        return trajectory_masses(model, first, states, window.control, types, window.nodes, noise)

    def judge(masses: MassBelief, _: None) -> tuple[MassBelief, JudgedSteps]:
        judged = _judge_steps(model, with_window_masses(windows, masses), devices)
        return jax.vmap(weigh)(windows, judged.types, first), judged

    masses, rounds = jax.lax.scan(judge, first, length=2)  # One program to compile.
    return dataclasses.replace(jax.tree.map(lambda leaf: leaf[-1], rounds), masses=masses)


def with_window_masses(windows: Window, masses: MassBelief | None) -> Window:
    """The windows, whose bodies have the most probable masses."""
    return dataclasses.replace(windows, nodes=with_masses(windows.nodes, masses))


def _judge_steps(model: ContactDynamics, windows: Window, devices: int) -> JudgedSteps:
    steps, noise = WindowSteps(model, windows, devices), motion_noise(model)

    def judge(graph: EncodedGraph, after: Motion) -> Array:
        prior = model.prior_belief(graph)
        _, joint = without_change(prior)
        return edge_log_ratios(model, graph, joint, after, noise, held_where_near(prior))

    def apart(graph: EncodedGraph) -> Motion:
        inactive = jnp.zeros_like(graph.prior).at[:, 0].set(1.0)
        linear = model.linearize(model.cut_edges(graph, ContactBelief(inactive)))
        return linear(graph.position, graph.velocity, graph.control)

    graph = steps.encode(None)
    unhindered = steps.each(apart, graph)
    ratio = steps.each(judge, graph, steps.after)
    types = jax.vmap(partial(likeliest_types, edge_types=graph.edge_types))(graph.prior, ratio)
    before = jnp.concatenate([types[:, :1], types[:, :-1]], axis=1)
    return JudgedSteps(before, ratio, graph.prior, types, unhindered, graph.meeting)


class JudgedTrajectories(eqx.Module):
    """Whole trajectories, and what an earlier model of the same training says of their motion.

    Judging takes longer than learning from it, and the likelihoods change slowly.
    """

    every: WholeTrajectories
    judged: JudgedSteps

    def windows(self, count: int, length: int, key: PRNGKeyArray) -> tuple[Window, JudgedSteps]:
        """``count`` windows of ``length`` steps, drawn with their probabilities."""
        weight, states = self.every.weight, self.every.states
        drawn = draw_by(jnp.cumsum(weight.ravel()), count, key)
        index, start = jnp.divmod(drawn, weight.shape[1])
        steps = start[:, None] + jnp.arange(length + 1)
        nodes, masses = jax.tree.map(lambda leaf: leaf[index], (states.nodes, self.judged.masses))
        window = Window(
            position=states.position[index[:, None], steps],
            velocity=states.velocity[index[:, None], steps],
            control=states.control[index[:, None], steps[:, :-1]],
            nodes=nodes,
        )
        judged = dataclasses.replace(self.judged, masses=None)
        judged = jax.tree.map(lambda leaf: leaf[index[:, None], steps[:, :-1]], judged)
        return window, dataclasses.replace(judged, masses=masses)


class ObservedAtTimes(eqx.Module):
    """Judged trajectories that are observed in some segments of their steps alone."""

    given: JudgedTrajectories
    """States that are not observed are predicted: see `predict_unobserved`."""
    observed: Bool[Array, "B T"]
    """Whether the state that each step leads to is observed."""

    def draw(self, key: PRNGKeyArray) -> "ObservedAtTimes":
        """Some of them."""
        index = jax.random.randint(key, (_FILTERED,), 0, len(self.observed))
        return jax.tree.map(lambda leaf: leaf[index], self)


def observed_at_times(
    model: ContactDynamics, given: JudgedTrajectories, key: PRNGKeyArray
) -> ObservedAtTimes:
    """The trajectories with random segments in which nothing is observed."""
    observed = random_segments(key, given.every.real.shape)
    states = with_window_masses(given.every.states, given.judged.masses)
    judged = dataclasses.replace(given.judged, masses=None)
    states, judged = predict_unobserved(without_gradient(model), states, judged, observed)
    every = dataclasses.replace(given.every, states=states)
    return ObservedAtTimes(JudgedTrajectories(every, judged), observed)


def random_segments(key: PRNGKeyArray, shape: tuple[int, ...]) -> Bool[Array, "B T"]:
    """True in random segments of the steps, those after which the bodies are observed."""
    first_key, key = jax.random.split(key)
    first = jax.random.bernoulli(first_key, _RESUME / (_LAPSE + _RESUME), shape[:1])

    def step(on: Array, uniform: Array) -> tuple[Array, Array]:
        on = jnp.where(on, uniform >= _LAPSE, uniform < _RESUME)
        return on, on

    return jax.lax.scan(step, first, jax.random.uniform(key, shape[::-1]))[1].T


def seen_or_not(belief: ContactBelief, observed: Bool[Array, ""]) -> ContactBelief:
    """The belief about bodies that may have been observed."""
    return jax.tree.map(lambda one, other: jnp.where(observed, one, other), belief.observed, belief)


def predict_unobserved(
    model: ContactDynamics,
    trajectories: Window,
    judged: JudgedSteps,
    observed: Bool[Array, "B T"],
) -> tuple[Window, JudgedSteps]:
    """The trajectories with predicted states where none is observed, and their judged steps.

    Recorded states tell what the filter ought to predict: a body that is still beside the gripper
    was not let go. Along a rollout the states follow the likeliest types, so the filter is scored
    on such rollouts, by the recorded motion. Bodies that did not touch in it were free in that
    step, wherever the rollout has them.
    """
    touch = jnp.log(jnp.clip((1.0 - judged.prior[..., 0]) / _APART, _LEAST, 1.0))

    def along(window: Window, ratio: Array, observed: Array) -> ModelState:
        def step(state: ModelState, inputs: tuple) -> tuple[ModelState, ModelState]:
            control, ratio, observed, after = inputs
            graph = model.encode_state(state, control, window.nodes)
            belief, joint = model.predict_joint(state.belief, graph)
            linear = model.linearize(model.cut_edges(graph, belief))
            predicted = *linear(state.position, state.velocity, control), belief
            corrected = *after, posterior_by_motion(belief, joint, ratio).observed
            chosen = jax.tree.map(
                lambda one, other: jnp.where(observed, one, other), corrected, predicted
            )
            return ModelState(*chosen), state

        position, velocity = window.position[0], window.velocity[0]
        first = model.initial_belief(position, velocity, window.nodes)
        begin = ModelState(position, velocity, first)
        after = window.position[1:], window.velocity[1:]
        inputs = window.control, ratio, observed, after
        return jax.lax.scan(step, begin, inputs)[1]

    states = jax.vmap(along)(trajectories, judged.log_ratio, observed)
    begins = jnp.pad(observed, ((0, 0), (1, 0)), constant_values=True)[:, :-1, None]
    ratio = judged.log_ratio.at[..., 1:].add(jnp.where(begins, 0.0, touch)[..., None, None])
    replaced = dataclasses.replace(
        trajectories,
        position=trajectories.position.at[:, :-1].set(states.position),
        velocity=trajectories.velocity.at[:, :-1].set(states.velocity),
    )
    before = jnp.where(begins[..., None], judged.before, states.belief.type_probability)
    return replaced, dataclasses.replace(judged, before=before, log_ratio=ratio, meeting=None)


class SensorReports(eqx.Module):
    """What one sensor a trajectory reports of the state that each step leads to."""

    report: Float[Array, "B T E"]
    """1 contact, 0 none, NaN nothing."""
    false_alarm: Float[Array, " B"]
    """As the correction assumes it: see `ContactSensor`."""
    miss: Float[Array, " B"]


def random_reports(
    contact: Float[Array, "B T+1 E"], key: PRNGKeyArray, used: Bool[Array, "B T"]
) -> SensorReports:
    """Reports of recorded contacts at random error rates and delays, in the steps ``used``."""
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
    return SensorReports(
        jnp.where(known[..., None], report, jnp.nan),
        jnp.asarray(late_rate(false_alarm, delay)),
        jnp.asarray(late_rate(miss, delay)),
    )
