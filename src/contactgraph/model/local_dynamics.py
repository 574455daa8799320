"""How the nodes move, given which edges are active."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from contactgraph.model.coupled_head import CoupledHead
from contactgraph.model.linear_dynamics import LinearDynamics
from contactgraph.model.local_input import LocalInput, Step
from contactgraph.model.message_passing import TypedMessagePassing
from contactgraph.model.per_degree_head import PerDegreeHead
from contactgraph.model.spring_mass_damper import SpringMassDamper
from contactgraph.model.theta_method import ThetaMethod


class SpringMassDamperDynamics(eqx.Module):
    """Messages over the active edges, then a spring-mass-damper for every node, then one step."""

    message_passing: TypedMessagePassing
    head: CoupledHead | PerDegreeHead
    discretisation: ThetaMethod

    def parameters(self, local: LocalInput, dt: float, control_size: int) -> SpringMassDamper:
        """The parameters of every node at one step of `dt` [s], each [N, D]."""
        ends = jnp.stack([local.geometry.first, local.geometry.second])
        embedding, message = self.message_passing(
            local.node_features, local.edge_features, local.weight, ends
        )
        step = Step(self.discretisation.theta, dt, control_size)
        return self.head(local, embedding, message, step)

    def __call__(self, local: LocalInput, dt: float, control_size: int) -> LinearDynamics:
        """The linear step of every node."""
        return self.discretisation(self.parameters(local, dt, control_size), dt)


class FreeLinearDynamics(eqx.Module):
    """Messages over the active edges, then free matrices for every node (the paper's Full-AB).

    Nothing keeps these stable; they exist to be compared with.
    """

    message_passing: TypedMessagePassing
    head: eqx.nn.MLP
    dimension: int = eqx.field(static=True)
    control_size: int = eqx.field(static=True)

    def __init__(
        self,
        message_passing: TypedMessagePassing,
        *,
        dimension: int,
        control_size: int,
        key: PRNGKeyArray,
    ):
        width = message_passing.width
        self.message_passing = message_passing
        self.head = eqx.nn.MLP(width, dimension * (6 + 2 * control_size), width, 2, key=key)
        self.dimension = dimension
        self.control_size = control_size

    def __call__(self, local: LocalInput, dt: float, control_size: int) -> LinearDynamics:
        """The linear step of every node: the identity plus what the network adds to it."""
        ends = jnp.stack([local.geometry.first, local.geometry.second])
        embedding, _ = self.message_passing(
            local.node_features, local.edge_features, local.weight, ends
        )
        out = jax.vmap(self.head)(embedding)
        out = out.reshape(-1, self.dimension, 2, 3 + self.control_size)
        A = jnp.eye(2, dtype=out.dtype) + dt * out[..., :2]
        return LinearDynamics(A=A, B=dt * out[..., 3:], offset=dt * out[..., 2])
