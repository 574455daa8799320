"""The whole model: inference of the edges, local dynamics, one linear step."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot, softplus

from contactgraph.data import pair_indices
from contactgraph.model import ContactDynamics
from contactgraph.model.serialization import module_arrays
from eager.geometry import Geometry, geometry

MOST_HELD = 1.0 - 1e-3
PACE, IMPACT_SPEED, SMALLEST = 5.0, 0.1, 1e-6
NEAR = 0.03


@dataclass
class EncodedGraph:
    """The quantities of a step that do not depend on the belief."""

    geometry: Geometry
    node: Tensor
    edge: Tensor
    weight: Tensor
    message: Tensor


@dataclass
class Linear:
    """``x' = A x + B u + offset`` for each node and degree of freedom."""

    A: Tensor
    B: Tensor
    offset: Tensor

    def __call__(
        self, position: Tensor, velocity: Tensor, control: Tensor
    ) -> tuple[Tensor, Tensor]:
        """``control`` [..., U]."""
        state = torch.stack([position, velocity], dim=-1)
        moved = (self.A @ state[..., None])[..., 0] + self.offset
        moved = moved + (self.B * control[..., None, None, None, :]).sum(-1)
        return moved[..., 0], moved[..., 1]


class EagerModel(nn.Module):
    """A `gim_temp` model's equations with its weights. ``actuated`` [N] marks the driven nodes."""

    def __init__(self, model: ContactDynamics, actuated: np.ndarray) -> None:
        super().__init__()
        self.weights = {
            name: nn.Parameter(torch.tensor(array)) for name, array in module_arrays(model).items()
        }
        """By the names of the model's arrays."""
        self.dt, self.cutoff, self.prior = model.dt, model.cutoff, model.prior
        self.length = model.features.length
        self.temperature = model.inference.temperature
        self.pairs = torch.tensor(pair_indices(len(actuated)))
        count = torch.arange(len(actuated))
        self.jacobian = (self.pairs[:, 1:] == count).float() - (self.pairs[:, :1] == count).float()
        self.kind = one_hot(torch.tensor(actuated).long(), 2).float()
        self.edge_network = self._mlp("inference.message_passing.network", 3, last=nn.ReLU())
        self.local_network = self._mlp(
            "local_dynamics.message_passing.types.0.network", 3, last=nn.ReLU()
        )
        self.hold = self._mlp("local_dynamics.head.edge", 2)
        self.ground = self._mlp("local_dynamics.head.ground", 2)
        self.cell = nn.GRUCell(self.weights["inference.input.weight"].shape[1], 2)
        self.cell.weight_ih = self.weights["inference.input.weight"]
        self.cell.bias_ih = self.weights["inference.input.bias"]
        self.cell.weight_hh = self.weights["inference.hidden.weight"]
        self.cell.bias_hh = self.weights["inference.hidden.bias"]

    def _mlp(self, path: str, layers: int, last: nn.Module | None = None) -> nn.Sequential:
        parts: list[nn.Module] = []
        for number in range(layers):
            weight = self.weights[f"{path}.layers.{number}.weight"]
            layer = nn.Linear(weight.shape[1], weight.shape[0])
            layer.weight, layer.bias = weight, self.weights[f"{path}.layers.{number}.bias"]
            parts += [layer, nn.ReLU()]
        return nn.Sequential(*parts[:-1], *([] if last is None else [last]))

    @property
    def touch(self) -> Tensor:
        """The distance at which bodies touch, m."""
        return self.weights["features.contact_distance"]

    @property
    def theta(self) -> Tensor:
        """Of the theta method."""
        return 0.5 + 0.5 * torch.sigmoid(self.weights["local_dynamics.discretization.raw"])

    def encode(
        self,
        position: Tensor,
        velocity: Tensor,
        push: Tensor | None = None,
        candidate: Tensor | None = None,
    ) -> EncodedGraph:
        """``position``, ``velocity``, ``push`` [..., N, D]; ``candidate`` [..., E] bool."""
        edge_geometry = geometry(position, velocity, self.pairs, self.dt, self.touch, push)
        speed = torch.sqrt((velocity**2).sum(-1) + 1e-12)
        bounded = (speed / (1.0 + speed))[..., None]
        node = torch.cat([self.kind.expand(*speed.shape, 2), bounded], dim=-1)
        gaps = (
            torch.stack([edge_geometry.distance, edge_geometry.nearest], dim=-1)
            / self.touch.detach()
            - 1.0
        )
        close = gaps / (NEAR + gaps.abs())
        distance = edge_geometry.distance[..., None] / self.length - 1.0
        edge = torch.cat([close, distance, edge_geometry.fraction_after_impact[..., None]], dim=-1)
        part = (self.cutoff.outer - edge_geometry.nearest) / (self.cutoff.outer - self.cutoff.inner)
        part = part.clamp(0.0, 1.0)
        weight = part**2 * (3.0 - 2.0 * part)
        if candidate is not None:
            weight = weight * candidate
        message = 2.0 * self.edge_network(edge) * weight[..., None]
        return EncodedGraph(edge_geometry, node, edge, weight, message)

    def prior_belief(self, encoded: EncodedGraph) -> Tensor:
        """[..., E, 2]: the prior by distance alone."""
        touch, prior = self.touch.detach(), self.prior
        margin = (prior.margin * touch - encoded.geometry.nearest) / (prior.sharpness * touch)
        active = prior.min_probability + (1.0 - 2.0 * prior.min_probability) * torch.sigmoid(
            2.0 * margin
        )
        active = active * encoded.weight
        return torch.stack([1.0 - active, active], dim=-1)

    def predict_belief(self, belief: Tensor, message: Tensor, weight: Tensor) -> Tensor:
        """[..., E, 2] One step of the recurrent cell on every edge."""
        state = self.cell(message.reshape(-1, message.shape[-1]), belief.reshape(-1, 2))
        active = torch.softmax(state / self.temperature, dim=-1)[:, 1].reshape(weight.shape)
        active = active * weight
        return torch.stack([1.0 - active, active], dim=-1)

    def linear(self, encoded: EncodedGraph, belief: Tensor, velocity: Tensor) -> Linear:
        """The linear step, given which edges are active."""
        hard = one_hot(belief.argmax(-1), 2).to(belief.dtype)
        active = (hard + belief - belief.detach())[..., 1] * encoded.weight
        message = 2.0 * self.local_network(encoded.edge) * active[..., None]
        out = self.hold(message)
        hold = MOST_HELD * active * torch.sigmoid(out[..., 0] + 5.0)
        hold = hold / (1.0 - hold)
        spring = active * softplus(out[..., 1] - 6.0)
        rest = active * softplus(out[..., 2]) * self.length
        ground = softplus(self.ground(encoded.node)[..., 0] - 6.0)
        mass = torch.exp(PACE * self.kind @ self.weights["local_dynamics.head.log_mass"])
        gain = (PACE * self.kind @ self.weights["local_dynamics.head.gain_root"]) ** 2
        return self._moved(encoded.geometry, velocity, (hold, spring, rest), mass, ground, gain)

    def _moved(
        self,
        edge_geometry: Geometry,
        velocity: Tensor,
        edges: Sequence[Tensor],
        mass: Tensor,
        ground: Tensor,
        gain: Tensor,
    ) -> Linear:
        """The network of masses, dampers and springs, solved, as one system per node."""
        (hold, spring, rest), J, dt, theta = edges, self.jacobian, self.dt, self.theta
        stiff = hold + spring
        inertia = torch.diag_embed(mass + ground)
        inverse = torch.linalg.inv(J.T @ (stiff[..., None] * J) + inertia)
        direction = edge_geometry.displacement / edge_geometry.distance[..., None]
        stretch = edge_geometry.displacement - rest[..., None] * direction
        impulse = (
            stiff[..., None] * edge_geometry.relative_velocity + spring[..., None] * stretch / dt
        )
        late = (edge_geometry.fraction_after_impact - theta) * hold
        change = -inverse @ (J.T @ impulse + ground[..., None] * velocity)
        shift = -dt * inverse @ (J.T @ (late[..., None] * edge_geometry.relative_velocity))
        response = inverse @ gain
        own = torch.diagonal(inverse, dim1=-2, dim2=-1) * mass
        size = torch.sqrt((change**2).sum(-1) + SMALLEST**2)
        impact = (1.0 - own) * size / (size + IMPACT_SPEED)
        part = ((inverse @ ground[..., None])[..., 0] + impact).clamp(0.0, 1.0)
        damper = part / (1.0 - theta * part)
        end = velocity + change / (part + SMALLEST)[..., None]
        return self._step(damper, end, response, shift)

    def _step(self, damper: Tensor, end: Tensor, response: Tensor, shift: Tensor) -> Linear:
        """The theta method on a damper to a moving end; there are no springs to a fixed one."""
        theta, dt = self.theta, self.dt
        den = 1.0 + theta * damper
        A22 = (1.0 - (1.0 - theta) * damper) / den
        A12 = dt * (1.0 - theta + theta * A22)
        rows = [
            torch.stack([torch.ones_like(A12), A12], dim=-1),
            torch.stack([torch.zeros_like(A22), A22], dim=-1),
        ]
        A = torch.stack(rows, dim=-2)[..., None, :, :].expand(*end.shape, 2, 2)
        # The network's response to a push is already damped.
        B2 = (dt * response)[..., None, None] * torch.eye(end.shape[-1])
        offset2 = (damper / den)[..., None] * end
        offset = torch.stack([theta * dt * offset2 + shift, offset2], dim=-1)
        return Linear(A, torch.stack([theta * dt * B2, B2], dim=-2), offset)

    def linear_step(
        self,
        position: Tensor,
        velocity: Tensor,
        belief: Tensor,
        push: Tensor | None,
        candidate: Tensor | None = None,
    ) -> tuple[Linear, Tensor]:
        """The dynamics of the coming step, and the belief they rest on."""
        encoded = self.encode(position, velocity, push, candidate)
        belief = self.predict_belief(belief, encoded.message, encoded.weight)
        return self.linear(encoded, belief, velocity), belief

    def control_sensitivity(self, position: Tensor, velocity: Tensor, belief: Tensor) -> Tensor:
        """[N, D, U] m/N, if only the present contacts hold."""
        holds = 1.0 - belief[..., 0] > 0.5
        return self.linear_step(position, velocity, belief, None, holds)[0].B[..., 0, :]

    @torch.no_grad()
    def rollout(self, position: Tensor, velocity: Tensor, controls: Tensor) -> Tensor:
        """[T, N, D] All positions that follow; in a loop over time."""
        belief = self.prior_belief(self.encode(position, velocity))
        response = self.control_sensitivity(position, velocity, belief)
        positions = []
        for control in controls:
            push = (response * control).sum(-1)
            linear, belief = self.linear_step(position, velocity, belief, push)
            position, velocity = linear(position, velocity, control)
            response = linear.B[..., 0, :]
            positions.append(position)
        return torch.stack(positions)
