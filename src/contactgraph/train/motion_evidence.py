"""E-step: what the motion of recorded steps says of every edge, and of the masses of the bodies.

The observed motion of a step says of every edge how likely it is with each pair of types, at the
start and in the end of the step: log ratios, of which no gradient is taken. All steps of a
trajectory together, with the model's transitions, say which type each edge has, and since when.
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.geometry import Meeting
from contactgraph.bodies.graph import EdgeType, EncodedGraph, first_where
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.inference.contact_belief import (
    ContactBelief,
    ContactSensor,
    correct,
    posterior_by_motion,
    report_likelihood,
    without_change,
)
from contactgraph.inference.edge_inference import smoothed_flows
from contactgraph.inference.motion_noise import Motion
from contactgraph.model.body_mass import MassBelief, first_masses, trajectory_masses
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.motion_likelihood import edge_log_ratios, motion_noise
from contactgraph.train.batch import map_steps
from contactgraph.train.window_loss import edges_of, encode_steps

_LEAST = 1e-6
_LABELS = ContactSensor(false_alarm=0.01, miss=0.01)
"""What recorded contacts are taken for."""


class MotionEvidence(eqx.Module):
    """What the motion of every step of a batch of windows says, without gradient."""

    before: Float[Array, "B L E K"]
    """`types` of the step before each step, or likely ones."""
    log_ratio: Float[Array, "B L E K K"]
    """`edge_log_ratios`."""
    flow: Float[Array, "B L E K A K"]
    """`smoothed_flows` by the model's transitions."""
    types: Float[Array, "B L E K"]
    """The likeliest type of each edge in each step by all steps, one-hot."""
    without_edges: Motion
    """[B, L, N, D] m and m/s; where each step would lead."""
    meeting: Meeting | None
    """[B, L, ...] `Geometry.meeting` of `EncodedGraph.contact_points`. None: to be found again."""
    masses: MassBelief | None
    """[B, L, N] by the motion of all steps, hence alike. None: bodies of a type weigh the same."""

    def weighed(self, windows: TrajectoryBatch[Array]) -> TrajectoryBatch[Array]:
        """The windows, whose bodies have the most probable masses."""
        if self.masses is None:
            return windows
        return windows._replace(nodes=windows.nodes._replace(log_mass=self.masses.mean[:, 0]))


def without_gradient(model: ContactDynamics) -> ContactDynamics:
    """The model, of which no gradient is taken."""
    arrays, others = eqx.partition(model, eqx.is_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), others)


def motion_evidence(
    model: ContactDynamics,
    windows: TrajectoryBatch[Array],
    devices: int = 1,
    reports_touch: bool = True,
) -> MotionEvidence:
    """The likelihood of the recorded motion of every step, and of recorded contacts.

    Where masses differ within a type, contacts are judged with the usual masses, then the motion
    with these contacts tells each body's own mass, with which contacts are judged again.
    """
    model = without_gradient(model)
    first, noise = jax.vmap(partial(first_masses, model))(windows.nodes), motion_noise(model)
    if first is None:
        return _evidence(model, windows, devices, reports_touch)
    steps = windows.control.shape[1]

    def weigh(window: TrajectoryBatch[Array], types: Array, first: MassBelief) -> MassBelief:
        states = window.position, window.velocity
        return trajectory_masses(model, first, states, window.control, types, window.nodes, noise)

    def judge(masses: MassBelief, _: None) -> tuple[MassBelief, MotionEvidence]:
        nodes = windows.nodes._replace(log_mass=masses.mean)
        found = _evidence(model, windows._replace(nodes=nodes), devices, reports_touch)
        return jax.vmap(weigh)(windows, found.types, first), found

    masses, rounds = jax.lax.scan(judge, first, length=2)  # One program to compile.
    found = jax.tree.map(lambda leaf: leaf[-1], rounds)
    masses = jax.tree.map(lambda leaf: jnp.repeat(leaf[:, None], steps, axis=1), masses)
    return dataclasses.replace(found, masses=masses)


def _evidence(
    model: ContactDynamics, windows: TrajectoryBatch[Array], devices: int, reports_touch: bool
) -> MotionEvidence:
    noise = motion_noise(model)
    each_step = partial(map_steps, edges=edges_of(model, windows), devices=devices)

    def judge(graph: EncodedGraph, after: Motion) -> Array:
        prior = model.prior_belief(graph)
        _, joint = without_change(prior)
        return edge_log_ratios(model, graph, joint, after, noise, held_where_near(prior))

    def apart(graph: EncodedGraph) -> Motion:
        inactive = jnp.zeros_like(graph.prior).at[:, 0].set(1.0)
        linear = model.linearize(model.cut_edges(graph, ContactBelief(inactive)))
        return linear(graph.bodies.position, graph.bodies.velocity, graph.control)

    graph = encode_steps(model, windows, devices=devices)
    without_edges = each_step(apart, graph)
    ratio = each_step(judge, graph, (windows.position[:, 1:], windows.velocity[:, 1:]))
    if windows.contact is not None:
        labels = _label_ratios(windows.contact[:, 1:], graph.edge_types, reports_touch)
        ratio += labels[..., None, :]
    flow = jax.vmap(partial(smoothed_steps, model))(graph, ratio)
    smoothed = jnp.sum(flow, axis=(-3, -2))
    types = jax.nn.one_hot(jnp.argmax(smoothed, axis=-1), smoothed.shape[-1], dtype=smoothed.dtype)
    before = jnp.concatenate([types[:, :1], types[:, :-1]], axis=1)
    meeting = graph.contact_points.meeting
    return MotionEvidence(before, ratio, flow, types, without_edges, meeting, None)


def smoothed_steps(
    model: ContactDynamics, graph: EncodedGraph, log_ratio: Float[Array, "L E K K"]
) -> Float[Array, "L E K A K"]:
    """`smoothed_flows` of a window by the model's transitions: one step often leaves open whether
    a body is held, those around it do not."""
    first = model.prior_belief(jax.tree.map(lambda leaf: leaf[0], graph))
    transitions = jax.vmap(model.transitions)(graph)
    table = model.inference.table(first)
    return smoothed_flows(model.inference, table, graph.embedding, transitions, log_ratio)


def _label_ratios(
    contact: Float[Array, "B L E"], edge_types: tuple[EdgeType, ...], reports_touch: bool
) -> Float[Array, "B L E K"]:
    """Log-likelihood of recorded contacts of each type; 0 where none is recorded."""
    sensor = dataclasses.replace(_LABELS, reports_touch=reports_touch)
    recorded = jnp.isfinite(contact)
    likelihood = report_likelihood(jnp.where(recorded, contact, 0.5), sensor, edge_types)
    return jnp.where(recorded[..., None], jnp.log(likelihood), 0.0)


def held_where_near(prior: ContactBelief) -> Float[Array, "E K"]:
    """One-hot types of edges not judged yet: the first that holds, where contact is likely.

    The prior does not tell touch from hold. Bodies that are held in a group move as they do
    because of all its bonds: were the others taken for touches, each would seem to be one, and the
    dynamics would learn masses with which that is true.
    """
    types, hold = prior.type_probability, first_where(each.holds for each in prior.edge_types)
    index = jnp.where(types[..., 0] < 0.5, hold, 0)
    return jax.nn.one_hot(index, types.shape[-1], dtype=types.dtype)


def encode_evidence(
    model: ContactDynamics, windows: TrajectoryBatch[Array], evidence: MotionEvidence
) -> EncodedGraph:
    """[B, L, ...] the steps' graphs, with gradients of the inference alone."""
    learned = dataclasses.replace(without_gradient(model), inference=model.inference)
    before = ContactBelief(evidence.before, edge_types=model.inference.edge_types)
    return encode_steps(learned, evidence.weighed(windows), before, evidence.meeting)


class FilteredSteps(eqx.Module):
    """Beliefs about the steps of a trajectory, each from the steps up to it."""

    by_motion: ContactBelief
    """[T, ...] corrected by the motion of the step."""
    after: ContactBelief
    """[T, ...] corrected by a report, too."""
    score: Float[Array, "T E"]
    """Negative log-likelihood of the motion."""


def filter_steps(
    model: ContactDynamics,
    graph: EncodedGraph,
    log_ratio: Float[Array, "T E K K"],
    report: Float[Array, "T E"] | None = None,
    sensor: ContactSensor | None = None,
) -> FilteredSteps:
    """The beliefs along a trajectory, corrected by its motion.

    Where there is a ``sensor``, so does its ``report``: 1 contact, 0 none, NaN nothing.
    """

    def step(belief: ContactBelief, inputs: tuple) -> tuple[ContactBelief, FilteredSteps]:
        graph, ratio, report = inputs
        predicted, joint = model.predict_joint(belief, graph)
        score = -jax.nn.logsumexp(jnp.log(jnp.maximum(joint, _LEAST)) + ratio, axis=(1, 2))
        by_motion = posterior_by_motion(predicted, joint, ratio)
        after = by_motion if sensor is None else correct(by_motion, report, sensor)
        return after, FilteredSteps(by_motion, after, score)

    first = model.prior_belief(jax.tree.map(lambda leaf: leaf[0], graph))
    return jax.lax.scan(step, first, (graph, log_ratio, report))[1]
