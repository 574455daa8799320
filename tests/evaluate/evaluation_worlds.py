"""Models written by hand, whose predictions can be known without running them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from contactgraph.data import Scene, Trajectory, pair_indices
from contactgraph.evaluate import control_task
from contactgraph.model import ContactBelief, LinearDynamics, ModelState, Nodes, two_type_belief
from contactgraph.policies import task_policy

DT = 0.05


class GluedBodies(eqx.Module):
    """Bodies of 1 kg; an edge once believed stays, and makes one rigid group of its nodes.

    Corrected by true contacts this is exactly the frozen-contact world. With a ``reach`` edges
    also become active where nodes are nearer than it, now or one step ahead. Both are arrays, so
    that worlds that differ in them share compiled programs.
    """

    theta: Array = eqx.field(converter=jnp.asarray, default=0.55)
    reach: Array = eqx.field(converter=jnp.asarray, default=0.0)

    def initial_belief(self, position, velocity, nodes: Nodes) -> ContactBelief:
        return two_type_belief(jnp.full(nodes.candidate.shape, 0.1, position.dtype))

    def linear_step(self, state: ModelState, control: Array, nodes: Nodes):
        N, D = state.position.shape
        first, second = pair_indices(N).T
        gap = state.position[first] - state.position[second]
        coming = gap + DT * (state.velocity[first] - state.velocity[second])
        near = jnp.minimum(jnp.sum(gap**2, axis=-1), jnp.sum(coming**2, axis=-1)) < self.reach**2
        active = nodes.candidate & (near | (state.belief.probability > 0.5))
        group = jnp.eye(N).at[first, second].set(active).at[second, first].set(active)
        for _ in range(N):
            group = jnp.minimum(group @ group, 1.0)
        members = jnp.maximum(jnp.sum(group * nodes.mask, axis=1), 1.0)
        inverse = jnp.broadcast_to((group @ nodes.actuated / members)[:, None], (N, D))
        # The group's common velocity: nothing changes where it has one already.
        common = group @ (state.velocity * nodes.mask[:, None]) / members[:, None]
        jump = common - state.velocity
        one, zero = jnp.ones((N, D)), jnp.zeros((N, D))
        A = jnp.stack([jnp.stack([one, DT * one], -1), jnp.stack([zero, one], -1)], -2)
        push = jnp.stack([self.theta * DT**2 * inverse, DT * inverse], -1)
        B = push[..., None] * jnp.eye(D)[:, None, :]
        # Beliefs short of certainty, so that one measurement turns them.
        return LinearDynamics(A, B, jnp.stack([zero, jump], -1)), two_type_belief(
            jnp.where(active, 0.9, 0.1).astype(state.position.dtype)
        )


class Fades(GluedBodies):
    """Is sure of every edge at first, and a fifth less so with every step."""

    def initial_belief(self, position, velocity, nodes: Nodes) -> ContactBelief:
        return two_type_belief(jnp.ones(nodes.candidate.shape, position.dtype))

    def linear_step(self, state: ModelState, control: Array, nodes: Nodes):
        linear, _ = GluedBodies(self.theta).linear_step(state, control, nodes)
        return linear, two_type_belief(0.8 * state.belief.probability)


class Explodes(GluedBodies):
    """Answers infinity."""

    def linear_step(self, state: ModelState, control: Array, nodes: Nodes):
        linear, belief = GluedBodies(self.theta).linear_step(state, control, nodes)
        return LinearDynamics(linear.A, linear.B, linear.offset + jnp.inf), belief


def scene_of(count: int, **fields) -> Scene:
    return Scene(
        node_name=tuple(f"node-{index}" for index in range(count)),
        node_type=("gripper", *["object"] * (count - 1)),
        actuated=np.arange(count) == 0,
        dt=DT,
        **fields,
    )


def random_run(count: int, steps: int, seed: int, **fields) -> Trajectory:
    """Motion and contacts drawn at random: nothing holds in it but shapes."""
    rng = np.random.default_rng(seed)
    held = rng.random((steps + 1, count, count)) < 0.3
    # Held for 5 states at a time, so that there are windows with and without a change.
    contact = np.triu(held[np.arange(steps + 1) // 5], 1)
    return Trajectory(
        scene_of(count, mass=np.ones(count), **fields),
        position=np.cumsum(0.02 * rng.normal(size=(steps + 1, count, 2)), axis=0),
        velocity=rng.normal(size=(steps + 1, count, 2)),
        control=rng.normal(size=(steps, 2)),
        contact=contact | contact.swapaxes(1, 2),
    )


def by_model(model, make, episodes, seed, on_episode=None, **options):
    """Metrics and trajectories of a model under MPC; ``options`` are `task_policy`'s."""
    task = make()
    policy = task_policy(model, task, **options)
    result = control_task(policy, task, episodes, seed, on_episode=on_episode)
    return result.metrics, list(result.trajectories)
