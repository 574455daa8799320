"""Small models that the control tests plan with; each has the interface of `StepModel`."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from contactgraph.control import LQRProblem
from contactgraph.data.graph import pair_indices
from contactgraph.model import ContactBelief, LinearDynamics, ModelState, Nodes, two_type_belief

DT = 0.05


def nodes_of(count: int, capacity: int) -> Nodes:
    mask = np.arange(capacity) < count
    pairs = pair_indices(capacity)
    return Nodes(
        actuated=jnp.asarray(np.arange(capacity) == 0),
        mask=jnp.asarray(mask),
        candidate=jnp.asarray(mask[pairs].all(axis=1)),
    )


def state_of(position, velocity, probability=None) -> ModelState:
    position, velocity = jnp.asarray(position), jnp.asarray(velocity)
    edges = len(pair_indices(len(position)))
    belief = jnp.zeros(edges) if probability is None else jnp.asarray(probability)
    return ModelState(position, velocity, two_type_belief(belief.astype(position.dtype)))


def blocks(A21, A22, B2, offset2) -> LinearDynamics:
    """Each argument [N, D]; B2 [N, D, U]. Position moves with the old velocity (theta = 0)."""
    one = jnp.ones_like(A21)
    return LinearDynamics(
        A=jnp.stack([jnp.stack([one, DT * one], axis=-1), jnp.stack([A21, A22], axis=-1)], axis=-2),
        B=jnp.stack([jnp.zeros_like(B2), B2], axis=-2),
        offset=jnp.stack([jnp.zeros_like(offset2), offset2], axis=-1),
    )


def varying_problem(
    rng: np.random.Generator, horizon: int, n: int, U: int, spread: float, least: float
) -> LQRProblem:
    """A random problem with every term: A is the identity and ``spread``, R at least ``least``."""
    root_Q, root_R = rng.normal(size=(horizon + 1, n, n)), rng.normal(size=(horizon, U, U))
    return LQRProblem(
        A=np.eye(n) + spread * rng.normal(size=(horizon, n, n)),
        B=rng.normal(size=(horizon, n, U)),
        offset=rng.normal(size=(horizon, n)),
        Q=root_Q @ root_Q.swapaxes(1, 2),
        R=root_R @ root_R.swapaxes(1, 2) + least * np.eye(U),
        q=rng.normal(size=(horizon + 1, n)),
        r=rng.normal(size=(horizon, U)),
    )


class Clock:
    """Every reading is ``period`` seconds after the one before."""

    def __init__(self):
        self.now, self.period = 0.0, 0.0

    def __call__(self):
        self.now += self.period
        return self.now


class Apart(eqx.Module):
    """Believes at first that nothing is in contact."""

    def initial_belief(self, position, velocity, nodes: Nodes) -> ContactBelief:
        return two_type_belief(jnp.zeros(nodes.candidate.shape, position.dtype))


class StickyBodies(Apart):
    """Bodies of 1 kg; one closer than ``reach`` to node 0 sticks to it: hard switches.

    A stuck pair has the mass of both, and common velocity from the step of the touch on.
    """

    reach: float = 0.1

    def linear_step(self, state: ModelState, control, nodes: Nodes):
        pairs = pair_indices(state.position.shape[0])
        first, second = pairs[:, 0], pairs[:, 1]
        gap = jnp.linalg.norm(state.position[first] - state.position[second] + 1e-9, axis=-1)
        active = nodes.candidate & (first == 0)
        active = active & ((gap < self.reach) | (state.belief.probability > 0.5))
        probability = jnp.where(active, 0.98, 0.02)
        held = jnp.zeros(state.position.shape[0], bool).at[second].max(active)
        held = held.at[0].set(jnp.any(active))[:, None]
        members = jnp.maximum(jnp.sum(held), 1)
        common = jnp.sum(jnp.where(held, state.velocity, 0.0), axis=0) / members
        inverse = jnp.where(held, 1.0 / members, jnp.where(nodes.actuated[:, None], 1.0, 0.0))
        inverse = inverse * jnp.ones_like(state.position)
        zero = jnp.zeros_like(state.position)
        U = state.position.shape[-1]
        B2 = DT * inverse[..., None] * jnp.eye(U)
        jump = jnp.where(held, common - state.velocity, 0.0)
        return blocks(zero, zero + 1.0, B2, jump), two_type_belief(probability)


class Pendulum(Apart):
    """One upright pendulum of 1 m: nonlinear, smooth; position is the angle, 0 is up."""

    gravity: float = 9.81

    def linear_step(self, state: ModelState, control, nodes: Nodes):
        angle = state.position
        stiffness = self.gravity * jnp.sinc(angle / jnp.pi)
        one = jnp.ones_like(angle)
        linear = blocks(DT * stiffness, one, DT * one[..., None], 0.0 * one)
        return linear, state.belief


class RandomModel(Apart):
    """Random springs that depend on the state smoothly, and switch where nodes come close."""

    weight: jnp.ndarray
    """[4, N, D]"""
    B2: jnp.ndarray
    """[N, D, U]"""
    switch: jnp.ndarray
    """[] how much the edge matters."""

    def linear_step(self, state: ModelState, control, nodes: Nodes):
        x, v = state.position, state.velocity
        close = (jnp.sum((x[0] - x[1]) ** 2) < 0.5).astype(x.dtype) * self.switch
        A21 = -DT * (1.0 + jnp.sin(3 * x * self.weight[0])) * (1 + close)
        A22 = 1.0 - DT * jnp.abs(self.weight[1]) + 0.0 * v
        offset = DT * (self.weight[2] * close + jnp.cos(x[::-1]) * self.weight[3])
        probability = jnp.full(nodes.candidate.shape, 0.02 + 0.9 * close / (1 + self.switch))
        return blocks(A21, A22, DT * self.B2 * (1 + close), offset), two_type_belief(probability)


class Broken(Apart):
    """Answers NaN once node 0 is beyond ``edge``; everywhere where it is None."""

    edge: float | None = None

    def linear_step(self, state: ModelState, control, nodes: Nodes):
        one = jnp.ones_like(state.position)
        beyond = True if self.edge is None else state.position[0, 0] > self.edge
        A22 = jnp.where(beyond, jnp.nan, one)
        U = state.position.shape[-1]
        return blocks(0 * one, A22, DT * one[..., None] * jnp.eye(U), 0 * one), state.belief
