"""Growth of rollouts, on models with known dynamics."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from contactgraph.data import Dataset, InvalidInputError, Scene, Trajectory
from contactgraph.evaluate import rollout_growth
from contactgraph.model import ContactBelief, LinearDynamics, ModelState, Nodes

STEPS = 40


class Fixed(eqx.Module):
    """The same A for every node, degree of freedom and step; control is a push on velocity."""

    A: Array
    dt: float = eqx.field(static=True, default=0.05)
    dimension: int = eqx.field(static=True, default=2)
    control_size: int = eqx.field(static=True, default=2)

    def initial_belief(self, position: Array, velocity: Array, nodes: Nodes) -> ContactBelief:
        count = position.shape[0]
        edges = count * (count - 1) // 2
        return ContactBelief(jnp.zeros((edges, 2)).at[:, 0].set(1.0))

    def linear_step(
        self, state: ModelState, control: Array, nodes: Nodes
    ) -> tuple[LinearDynamics, ContactBelief]:
        shape = state.position.shape
        A = jnp.broadcast_to(self.A, (*shape, 2, 2))
        B = jnp.zeros((*shape, 2, 2)).at[..., 1, :].set(0.5)
        return LinearDynamics(A, B, jnp.zeros((*shape, 2))), state.belief


def trajectories(*, nodes: int = 2, force: float = 0.0) -> Dataset:
    position = np.ones((STEPS + 1, nodes, 2))
    scene = Scene(("a", "b", "c")[:nodes], ("x",) * nodes, np.eye(nodes, dtype=bool)[0], 0.05, 2)
    control = np.full((STEPS, 2), force)
    trajectory = Trajectory(scene, position, np.zeros_like(position), control)
    return Dataset((trajectory, trajectory))


def test_growth_of_a_known_factor() -> None:
    model = Fixed(jnp.diag(jnp.array([1.1, 0.5])))
    found = rollout_growth(model, trajectories(), STEPS)
    assert found["growth_free"] == pytest.approx(1.1**STEPS, rel=1e-4)
    assert found["spectral_radius"] == pytest.approx(1.1, rel=1e-6)
    assert found["growth_recorded"] == pytest.approx(1.0)
    assert found["finite_rollouts"] == 1.0


def test_rotations_do_not_grow_and_have_complex_eigenvalues() -> None:
    turn = 0.9 * jnp.array([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]])
    found = rollout_growth(Fixed(turn), trajectories(), STEPS)
    assert found["spectral_radius"] == pytest.approx(0.9, rel=1e-5)
    assert found["growth_free"] == pytest.approx(0.9, rel=1e-5)


def test_control_acts_and_ends_with_the_trajectory() -> None:
    model = Fixed(jnp.eye(2))
    found = rollout_growth(model, trajectories(force=1.0), 2 * STEPS)
    # Both components of the control push every velocity: 40 steps of 1, then nothing.
    assert found["growth_driven"] == pytest.approx(math.hypot(1.0, STEPS), rel=1e-5)
    assert found["growth_free"] == pytest.approx(1.0)


def test_padding_changes_nothing_and_overflow_is_infinite() -> None:
    wild = Fixed(jnp.diag(jnp.array([1e3, 1.0])))
    found = rollout_growth(wild, trajectories(), STEPS)
    assert found["growth_free"] == math.inf
    assert found["finite_rollouts"] == 0.0
    model = Fixed(jnp.diag(jnp.array([1.1, 0.5])))
    both = Dataset((*trajectories().trajectories, *trajectories(nodes=3).trajectories))
    assert rollout_growth(model, both, 5)["growth_free"] == pytest.approx(1.1**5, rel=1e-4)


def test_steps_must_be_positive() -> None:
    with pytest.raises(InvalidInputError, match="steps must be at least 1, found 0"):
        rollout_growth(Fixed(jnp.eye(2)), trajectories(), 0)
