"""Expectation maximisation (Baum-Welch): the motion is judged, then the model learns from that.

The E-step draws whole trajectories and finds what their motion says of every edge: see
`MotionEvidence`. In the M-step the dynamics learn from windows of them with the likeliest types of
the very step, so they do not pay for contacts that nothing could predict; and the transitions of
the inference learn as a classifier of the expected transitions.

Each part is a program of its own, since programs compile in more than proportion to their size, and
the held-out trajectories are judged by the program of the others.
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from contactgraph.bodies.graph import EdgeList
from contactgraph.data.dataset import Dataset
from contactgraph.data.graph import pair_indices
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.inference.contact_belief import ContactBelief
from contactgraph.inference.motion_noise import Motion
from contactgraph.model.body_mass import mass_score
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.batch import WindowSource
from contactgraph.train.held_out import HeldOutWindows
from contactgraph.train.motion_evidence import (
    MotionEvidence,
    encode_evidence,
    filter_steps,
    motion_evidence,
)
from contactgraph.train.objective import (
    FitState,
    LossTerms,
    Objective,
    TrainConfig,
    TrainingData,
    bounded_distance,
    descend,
    optimiser_of,
)
from contactgraph.train.window_loss import masked_mean, rollout_error

_SMALLEST = 1e-6
_JUDGED, _MOST, _LEAST = 6400, 32, 8
"""About as many steps are judged at once, of so many trajectories."""
_PERIOD = 25
"""Steps on the same judged trajectories."""
_CLASSIFIED = 8
"""Judged trajectories whose transitions are classified in a step."""
_judge = eqx.filter_jit(motion_evidence)


class ExpectationMaximisation(Objective):
    """`dynamics_loss` and `transition_loss`."""

    near_pairs = False  # the types of all pairs are judged
    least_burn, burn = 1, 20
    # Where geometry tells the contact, rollouts do not tell a filter that has hardly learned.
    compared_from = 0.75

    def optimiser(self, config: TrainConfig) -> optax.GradientTransformation:
        """Of the whole model."""
        return optimiser_of(config, bounded_distance(in_lengths=True))

    def checked(self, held_out: Dataset, steps: int, devices: int) -> Dataset:
        """As many as are judged at once."""
        return replace(held_out, trajectories=held_out.trajectories[: _count(steps, devices)])

    def advance(
        self, state: FitState, data: TrainingData, count: int, neighbor_list: EdgeList | None
    ) -> tuple[FitState, dict[str, Array]]:
        """See `Objective.advance`."""
        steps, split = data.source.weight.shape[1], data.split
        length = _PERIOD if count % _PERIOD == 0 else count
        periods, joined = [], state.step >= data.config.first_rollout
        for _ in range(count // length):
            state, drawn, key = _draw(state, data.source, _count(steps, split.parts))
            every = split.shard(drawn.trajectories)
            evidence = _judge(state.model, every, split.parts, data.reports_touch)
            state, terms = self._learn(state, data, drawn, evidence, key, length, joined)
            periods.append(terms)
        means = jax.tree.map(lambda *each: jnp.mean(jnp.stack(each)), *periods)
        return state, vars(means)

    @eqx.filter_jit
    def _learn(
        self,
        state: FitState,
        data: TrainingData,
        drawn: WindowSource,
        evidence: MotionEvidence,
        key: PRNGKeyArray,
        count: int,
        joined: Bool[Array, ""],
    ) -> tuple[FitState, LossTerms]:
        """``count`` steps: the M-step."""
        config = data.config
        params, static = eqx.partition(state.model, eqx.is_inexact_array)
        # A half of the windows is predicted from their first states, as soon as that counts.
        rolled_out = (jnp.arange(config.batch_size) % 2 == 1) & joined

        def loss(
            params: PyTree,
            windows: TrajectoryBatch[Array],
            of_windows: MotionEvidence,
            trajectories: TrajectoryBatch[Array],
            of_trajectories: MotionEvidence,
        ) -> tuple[Array, LossTerms]:
            model = eqx.combine(params, static)
            terms = dynamics_loss(model, windows, of_windows, rolled_out)
            likelihood = transition_loss(model, trajectories, of_trajectories)
            terms = replace(terms, likelihood=likelihood)
            return terms.total(config.weights), terms

        def slope(params: PyTree, key: PRNGKeyArray) -> tuple[PyTree, LossTerms]:
            key, draw_key = jax.random.split(key)
            trajectory, start = drawn.draw_starts(config.batch_size, key)
            steps = trajectory[:, None], start[:, None] + jnp.arange(drawn.length)
            of_windows = jax.tree.map(lambda leaf: leaf[steps], evidence)
            windows, of_windows = data.split.shard((drawn.take(trajectory, start), of_windows))
            windows = of_windows.weighed(windows)
            some = jax.random.randint(draw_key, (_CLASSIFIED,), 0, len(drawn.weight))
            every = jax.tree.map(lambda leaf: leaf[some], (drawn.trajectories, evidence))
            (_, terms), gradient = jax.value_and_grad(loss, has_aux=True)(
                params, windows, of_windows, *every
            )
            return gradient, terms

        keys, optimiser = jax.random.split(key, count), self.optimiser(config)
        params, optimiser_state, terms = descend(slope, optimiser, params, state.optimiser, keys)
        learned = replace(
            state,
            model=eqx.combine(params, static),
            optimiser=optimiser_state,
            step=state.step + count,
        )
        return learned, terms

    def first_beliefs(
        self, model: ContactDynamics, held_out: HeldOutWindows, devices: int
    ) -> tuple[ContactBelief, TrajectoryBatch[Array]]:
        """By the motion of all steps before the windows; of the masses, by that of all steps."""
        count = _count(held_out.source.weight.shape[1], devices)
        every = jax.tree.map(lambda leaf: leaf[:count], held_out.source.trajectories)
        evidence = _judge(model, every, devices)
        return _first_beliefs(model, held_out, every, evidence)


def _count(steps: int, devices: int) -> int:
    """How many trajectories of so many steps are judged at once, a multiple of ``devices``."""
    count = max(_LEAST, min(_MOST, _JUDGED // steps))
    return count + -count % devices


@eqx.filter_jit
def _draw(state: FitState, source: WindowSource, count: int) -> tuple:
    """The state with its next key, windows of whole trajectories, and a key."""
    key, draw_key, step_key = jax.random.split(jax.random.wrap_key_data(state.key), 3)
    state = replace(state, key=jax.random.key_data(key))
    return state, source.draw_trajectories(count, draw_key), step_key


def dynamics_loss(
    model: ContactDynamics,
    windows: TrajectoryBatch[Array],
    evidence: MotionEvidence,
    rolled_out: Bool[Array, " B"],
) -> LossTerms:
    """Terms over a batch of windows, given the likeliest types; the inference does not learn.

    Windows that are ``rolled_out`` are predicted from their first states, of the others each step
    from the recorded one.
    """
    position, velocity, in_reach = jax.vmap(partial(steps_of_types, model))(
        windows, evidence.types, evidence.before, rolled_out
    )
    after = windows.position[:, 1:], windows.velocity[:, 1:]
    error = jnp.sum(((position - after[0]) / model.dt) ** 2, axis=-1)
    error += jnp.sum((velocity - after[1]) ** 2, axis=-1)
    mobile = jnp.broadcast_to(windows.nodes.mobile[:, None], error.shape)
    single = mobile & ~rolled_out[:, None, None]
    assert model.prediction_noise is not None
    count = position.shape[2]
    incidence = np.any(pair_indices(count)[..., None] == np.arange(count), axis=1)
    score = model.prediction_noise.score(
        jax.lax.stop_gradient((position, velocity)),
        evidence.without_edges,
        after,
        jnp.einsum("en,blea->bln", incidence.astype(position.dtype), evidence.types[..., 1:]),
        model.dt,
    )
    near = jnp.any(in_reach[..., None] & incidence, axis=2)
    noise = masked_mean(score, single & near)
    if evidence.masses is not None:
        masses = jax.tree.map(lambda leaf: leaf[:, 0], evidence.masses)
        of_masses = jax.vmap(partial(mass_score, model))(masses, windows.nodes)
        noise += masked_mean(of_masses, windows.nodes.passive)
    rollout = jax.vmap(partial(rollout_error, model))((position, velocity), windows)
    return LossTerms.of(
        prediction=masked_mean(jnp.sqrt(error + _SMALLEST), single),
        squared=masked_mean(error, single),
        rollout=masked_mean(rollout, mobile & rolled_out[:, None, None]),
        noise=noise,
    )


def transition_loss(
    model: ContactDynamics,
    trajectories: TrajectoryBatch[Array],
    evidence: MotionEvidence,
) -> Float[Array, ""]:
    """Mean cross-entropy of the transitions of edges within the cutoff, nat; only they learn."""
    graph = encode_evidence(model, trajectories, evidence)
    transitions = jax.vmap(jax.vmap(model.transitions))(graph)
    cross = -jnp.sum(
        evidence.flow * jnp.log(jnp.maximum(transitions, _SMALLEST)), axis=(-3, -2, -1)
    )
    counted = (graph.weight > 0) & trajectories.step_mask[..., None]
    return masked_mean(cross, counted)


def steps_of_types(
    model: ContactDynamics,
    window: TrajectoryBatch[Array],
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
        position, velocity = jax.tree.map(
            lambda own, seen: jnp.where(rolled_out, own, seen), state, recorded
        )
        believed = ContactBelief(before, edge_types=model.inference.edge_types)
        graph = model.encode(position, velocity, control, window.nodes, believed)
        linear = model.linearize(model.cut_edges(graph, ContactBelief(types)))
        after = linear(position, velocity, control)
        return after, (*after, graph.weight > 0)

    recorded = window.position[:-1], window.velocity[:-1]
    first = window.position[0], window.velocity[0]
    return jax.lax.scan(step, first, (recorded, window.control, types, before))[1]


@eqx.filter_jit
def _first_beliefs(
    model: ContactDynamics,
    held_out: HeldOutWindows,
    trajectories: TrajectoryBatch[Array],
    evidence: MotionEvidence,
) -> tuple[ContactBelief, TrajectoryBatch[Array]]:
    """`ExpectationMaximisation.first_beliefs` by the evidence of whole trajectories."""
    last = held_out.trajectory, held_out.start + held_out.burn - 1
    graph = encode_evidence(model, trajectories, evidence)
    along = jax.vmap(partial(filter_steps, model))(graph, evidence.log_ratio)
    belief = jax.tree.map(lambda leaf: leaf[last], along.after)
    told = jax.tree.map(lambda leaf: leaf[last][:, None], evidence)
    return belief, told.weighed(held_out.windows)
