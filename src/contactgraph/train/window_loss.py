"""The paper's objective: errors of windows, one step and whole rollouts, and KL to the prior."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from contactgraph.bodies.geometry import Meeting
from contactgraph.bodies.graph import EdgeList, EncodedGraph, edge_count
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.inference.contact_belief import ContactBelief, nothing_active
from contactgraph.inference.motion_noise import Motion
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.batch import (
    WindowSource,
    add_distractor,
    chunked_vmap,
    map_steps,
)
from contactgraph.train.held_out import predict_window
from contactgraph.train.objective import (
    FitState,
    LossTerms,
    Objective,
    TrainingData,
    descend,
)

_SMALLEST = 1e-6
_ROLLOUT_POSITION = 0.5
"""Weight of a rollout's position errors, which add up over its steps, unlike velocity errors."""
_CLEARANCE = 1.03
"""Least distance of a distractor, in learned contact distances."""


class WindowObjective(Objective):
    """`window_loss`, and later in training `rollout_loss`, of windows with distractors."""

    def terms(
        self,
        model: ContactDynamics,
        windows: TrajectoryBatch[Array],
        source: WindowSource,
        key: PRNGKeyArray,
        devices: int,
    ) -> LossTerms:
        """The terms but that of rollouts, over a batch of ``windows`` of the ``source``."""
        return window_loss(model, windows, key, devices)

    @eqx.filter_jit
    def advance(
        self, state: FitState, data: TrainingData, count: int, neighbor_list: EdgeList | None
    ) -> tuple[FitState, dict[str, Array]]:
        """See `Objective.advance`; all in one scan.

        The rollout term is under a condition, because a second program would take as long to
        compile as to run. Where rollouts never count they are not compiled at all.
        """
        config, split = data.config, data.split
        # Just outside the learned contact distance, so that training determines that distance.
        nearest = _CLEARANCE * jnp.asarray(state.model.features.contact_distance)
        params, static = eqx.partition(state.model, eqx.is_inexact_array)

        def model_of(params: PyTree) -> ContactDynamics:
            return replace(eqx.combine(params, static), neighbor_list=neighbor_list)

        def loss(
            params: PyTree, windows: TrajectoryBatch[Array], key: PRNGKeyArray
        ) -> tuple[Array, LossTerms]:
            terms = self.terms(model_of(params), windows, data.source, key, split.parts)
            return terms.total(config.weights), terms

        def rolled_out(params: PyTree, windows: TrajectoryBatch[Array]) -> Array:
            return rollout_loss(model_of(params), windows, split.parts)

        def nothing(params: PyTree, windows: TrajectoryBatch[Array]) -> tuple[Array, PyTree]:
            return jnp.zeros(()), jax.tree.map(jnp.zeros_like, params)

        def slope(params: PyTree, key: PRNGKeyArray) -> tuple[PyTree, LossTerms]:
            draw_key, place_key, key = jax.random.split(key, 3)
            windows = split.shard(data.source.draw(config.batch_size, draw_key))
            for distractor_key in jax.random.split(place_key, data.distractors):
                windows = add_distractor(windows, nearest, 3.0 * nearest, distractor_key)
            (_, terms), gradient = jax.value_and_grad(loss, has_aux=True)(params, windows, key)
            if self.rolls_out and config.rollout_from < 1.0:
                joined, rolled = state.step >= config.first_rollout, jax.value_and_grad(rolled_out)
                rollout, further = jax.lax.cond(joined, rolled, nothing, params, windows)
                terms = replace(terms, rollout=rollout)
                gradient = jax.tree.map(
                    lambda one, other: one + config.weights.rollout * other, gradient, further
                )
            return gradient, terms

        def next_key(key: PRNGKeyArray, _: None) -> tuple[PRNGKeyArray, PRNGKeyArray]:
            key, step_key = jax.random.split(key)
            return key, step_key

        key, keys = jax.lax.scan(next_key, jax.random.wrap_key_data(state.key), length=count)
        optimiser = self.optimiser(config)
        params, optimiser_state, terms = descend(slope, optimiser, params, state.optimiser, keys)
        after = replace(
            state,
            model=eqx.combine(params, static),
            optimiser=optimiser_state,
            key=jax.random.key_data(key),
            step=state.step + count,
        )
        return after, vars(terms)


def window_loss(
    model: ContactDynamics, windows: TrajectoryBatch[Array], key: PRNGKeyArray, devices: int = 1
) -> LossTerms:
    """Loss terms over a batch of windows (every leaf of `windows` has a leading axis B).

    One-step prediction from every recorded state and KL to the prior: paper, eq. (3). Position
    errors are divided by dt, so that both halves of a state weigh alike; static bodies do not
    count. The windows are split over ``devices``.
    """
    graph = encode_steps(model, windows, devices=devices)
    prior, belief = _predicted_beliefs(model, graph)
    if graph.control_displacement is not None:  # The control moves what is held in a state.
        held = jax.tree.map(
            lambda first, each: jnp.concatenate([first[:, :1], each[:, :-1]], axis=1), prior, belief
        )
        graph = encode_steps(model, windows, jax.lax.stop_gradient(held), devices=devices)
        prior, belief = _predicted_beliefs(model, graph)

    def squared_error(
        graph: EncodedGraph, belief: ContactBelief, after: Motion, key: PRNGKeyArray
    ) -> Float[Array, " N"]:
        linear = model.linearize(model.cut_edges(graph, belief, key))
        position, velocity = linear(graph.bodies.position, graph.bodies.velocity, graph.control)
        error = jnp.sum(((position - after[0]) / model.dt) ** 2, axis=-1)
        return error + jnp.sum((velocity - after[1]) ** 2, axis=-1)

    keys = jax.random.split(key, windows.control.shape[:2])
    after = windows.position[:, 1:], windows.velocity[:, 1:]
    edges = edges_of(model, windows)
    error = map_steps(squared_error, graph, belief, after, keys, edges=edges, devices=devices)
    p = jnp.clip(belief.type_probability, _SMALLEST, 1.0)
    q = jnp.clip(prior.type_probability, _SMALLEST, 1.0)
    divergence = jnp.sum(p * (jnp.log(p) - jnp.log(q)), axis=-1)
    bodies = jnp.broadcast_to(windows.nodes.mobile[:, None], error.shape)
    return LossTerms.of(
        prediction=masked_mean(jnp.sqrt(error + _SMALLEST), bodies),
        squared=masked_mean(error, bodies),
        prior=masked_mean(divergence, graph.weight > 0),
    )


def edges_of(model: ContactDynamics, windows: TrajectoryBatch[Array]) -> int:
    """Number of edges of a step of these windows."""
    return edge_count(model.neighbor_list, windows.position.shape[-2])


def encode_steps(
    model: ContactDynamics,
    windows: TrajectoryBatch[Array],
    before: ContactBelief | None = None,
    meeting: Meeting | None = None,
    devices: int = 1,
) -> EncodedGraph:
    """[B, L, ...] stage 1 of every step, from its recorded state.

    ``before`` [B, L, ...] are the beliefs in these, by default that nothing is active; ``meeting``:
    see `ContactDynamics.encode`.
    """
    batch, length = windows.control.shape[:2]
    window = jnp.repeat(jnp.arange(batch)[:, None], length, axis=1)
    nothing = nothing_active(model.inference.edge_types)

    def encode(
        window: Array,
        position: Array,
        velocity: Array,
        control: Array,
        before: ContactBelief | None,
        meeting: Meeting | None,
    ) -> EncodedGraph:
        nodes = jax.tree.map(lambda leaf: leaf[window], windows.nodes)
        return model.encode(position, velocity, control, nodes, before or nothing, meeting)

    states = windows.position[:, :-1], windows.velocity[:, :-1], windows.control
    edges = edges_of(model, windows)
    return map_steps(encode, window, *states, before, meeting, edges=edges, devices=devices)


def _predicted_beliefs(
    model: ContactDynamics, graph: EncodedGraph
) -> tuple[ContactBelief, ContactBelief]:
    """Prior and, by stage 2 in a scan over time, predicted belief of every step [B, L, ...]."""
    prior = jax.vmap(jax.vmap(model.prior_belief))(graph)

    def predict(belief: ContactBelief, graph: EncodedGraph) -> tuple[ContactBelief, ContactBelief]:
        belief = model.predict_belief(belief, graph)
        return belief, belief

    def along(prior: ContactBelief, graph: EncodedGraph) -> ContactBelief:
        first = jax.tree.map(lambda leaf: leaf[0], prior)
        return jax.lax.scan(predict, first, graph)[1]

    return prior, jax.vmap(along)(prior, graph)


def masked_mean(values: Array, mask: Array) -> Array:
    """Mean of the values where the mask is true; 0 where it never is."""
    return jnp.sum(jnp.where(mask, values, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


def rollout_loss(
    model: ContactDynamics, windows: TrajectoryBatch[Array], devices: int = 1
) -> Float[Array, ""]:
    """`LossTerms.rollout` over a batch of windows, the only term that depends on whole rollouts."""

    def error(window: TrajectoryBatch[Array]) -> Float[Array, "L N"]:
        first = window.position[0], window.velocity[0], window.nodes
        states = predict_window(model, window, model.initial_belief(*first))
        return rollout_error(model, (states.position, states.velocity), window)

    each = chunked_vmap(error, windows, edges=edges_of(model, windows), devices=devices)
    return masked_mean(each, jnp.broadcast_to(windows.nodes.mobile[:, None], each.shape))


def rollout_error(
    model: ContactDynamics, predicted: Motion, window: TrajectoryBatch[Array]
) -> Float[Array, "L N"]:
    """Norm of the error of each predicted state of a window, m/s."""
    position, velocity = predicted
    position_error = _ROLLOUT_POSITION * (position - window.position[1:]) / model.dt
    velocity_error = velocity - window.velocity[1:]
    return jnp.sqrt(jnp.sum(position_error**2 + velocity_error**2, axis=-1) + _SMALLEST)
