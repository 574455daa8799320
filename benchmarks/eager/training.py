"""A training step: one-step errors and divergence from the prior over whole runs, then Adam."""

import torch
from torch import Tensor

from eager.model import EagerModel, EncodedGraph, Linear

SMALLEST = 1e-6


class Training:
    """Steps of Adam on a batch.

    ``position`` and ``velocity`` [B, T+1, N, D], ``control`` [B, T, U].
    """

    def __init__(
        self, model: EagerModel, position: Tensor, velocity: Tensor, control: Tensor
    ) -> None:
        self.model = model
        self.position, self.velocity, self.control = position, velocity, control
        self.optimiser = torch.optim.Adam(list(model.weights.values()), lr=3e-3)

    def step(self) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its gradients by the weights' names, before they are clipped."""
        self.optimiser.zero_grad()
        loss = self.loss()
        loss.backward()
        gradients = {name: weight.grad.clone() for name, weight in self.model.weights.items()}
        torch.nn.utils.clip_grad_norm_(self.model.weights.values(), 1.0)
        self.optimiser.step()
        return loss.detach(), gradients

    def loss(self) -> Tensor:
        """The weighted sum of `contactgraph.train.LossTerms` without a rollout."""
        model, dt = self.model, self.model.dt
        position, velocity = self.position[:, :-1], self.velocity[:, :-1]
        encoded, prior, belief = self._believed(self._pushes())
        x, v = model.linear(encoded, belief, velocity)(position, velocity, self.control)
        error = (((x - self.position[:, 1:]) / dt) ** 2).sum(-1)
        error = error + ((v - self.velocity[:, 1:]) ** 2).sum(-1)
        p, q = belief.clamp(SMALLEST, 1.0), prior.clamp(SMALLEST, 1.0)
        divergence = (p * (p.log() - q.log())).sum(-1)
        exists = encoded.weight > 0
        divergence = torch.where(exists, divergence, torch.zeros_like(divergence)).sum()
        divergence = divergence / exists.sum().clamp(min=1)
        return torch.sqrt(error + SMALLEST).mean() + error.mean() + 0.05 * divergence

    @torch.no_grad()
    def _pushes(self) -> Tensor:
        encoded, _, belief = self._believed(None)
        linear: Linear = self.model.linear(encoded, belief, self.velocity[:, :-1])
        response = linear.B[..., 0, :]
        before = torch.cat([response[:, :1], response[:, :-1]], dim=1)
        return (before * self.control[:, :, None, None, :]).sum(-1)

    def _believed(self, push: Tensor | None) -> tuple[EncodedGraph, Tensor, Tensor]:
        model = self.model
        encoded = model.encode(self.position[:, :-1], self.velocity[:, :-1], push)
        prior = model.prior_belief(encoded)
        belief, beliefs = prior[:, 0], []
        for t in range(self.control.shape[1]):
            belief = model.predict_belief(belief, encoded.message[:, t], encoded.weight[:, t])
            beliefs.append(belief)
        return encoded, prior, torch.stack(beliefs, dim=1)
