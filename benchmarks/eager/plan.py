"""iLQR: rollouts of the model in a loop, and a Riccati recursion in NumPy.

The rules by which a trial is accepted are those of `contactgraph.control.ILQR`, so that both make
the same plan. States are [position, velocity] of each degree of freedom, one after the other.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from eager.model import EagerModel

STEP_SIZES = (1.0, 0.5, 0.2)
ARMIJO, FIRST_DAMPING, LAST_DAMPING = 1e-4, 0.1, 1e6
TOLERANCE, ABSOLUTE_TOLERANCE = 1e-4, 1e-6


@dataclass
class Cost:
    """``(x - goal)^T Q (x - goal)`` at every step, ``u^T R u`` but at the last."""

    Q: np.ndarray
    R: np.ndarray
    goal: np.ndarray

    def __call__(self, states: np.ndarray, controls: np.ndarray) -> float:
        total = sum((x - self.goal) @ self.Q @ (x - self.goal) for x in states)
        return float(total + sum(u @ self.R @ u for u in controls))


@dataclass
class Reference:
    """A rollout and the dynamics along it."""

    states: np.ndarray
    controls: np.ndarray
    A: list[np.ndarray]
    B: list[np.ndarray]
    offset: list[np.ndarray]


@torch.no_grad()
def roll_out(
    model: EagerModel, start: tuple[Tensor, Tensor, Tensor], K: np.ndarray, k: np.ndarray
) -> Reference:
    """Follow ``u = K x + k``. ``start``: position, velocity and belief."""
    position, velocity, belief = start
    response = model.control_sensitivity(position, velocity, belief)
    found = Reference(np.zeros((0,)), np.zeros((0,)), [], [], [])
    states, controls = [_state(position, velocity)], []
    for gain, constant in zip(K, k, strict=True):
        controls.append(gain @ states[-1] + constant)
        control = torch.tensor(controls[-1], dtype=torch.float32)
        push = (response * control).sum(-1)
        linear, belief = model.linear_step(position, velocity, belief, push)
        position, velocity = linear(position, velocity, control)
        response = linear.B[..., 0, :]
        states.append(_state(position, velocity))
        found.A.append(torch.block_diag(*linear.A.reshape(-1, 2, 2)).double().numpy())
        found.B.append(linear.B.reshape(-1, len(constant)).double().numpy())
        found.offset.append(linear.offset.reshape(-1).double().numpy())
    found.states, found.controls = np.array(states), np.array(controls)
    return found


def _state(position: Tensor, velocity: Tensor) -> np.ndarray:
    return torch.stack([position, velocity], dim=-1).reshape(-1).double().numpy()


def improved(
    reference: Reference, cost: Cost, damping: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Gains, steps of the controls and the decrease of the cost to expect."""
    P, p = cost.Q, -cost.Q @ cost.goal
    gains, steps, decrease = [], [], 0.0
    for t in reversed(range(len(reference.controls))):
        A, B, x, u = reference.A[t], reference.B[t], reference.states[t], reference.controls[t]
        w = P @ reference.offset[t] + p
        S, G, g = cost.R + B.T @ P @ B, B.T @ P @ A, B.T @ w
        weight = damping * np.trace(S) / len(u)
        S = S + weight * np.eye(len(u))
        K = -np.linalg.solve(S, G)
        target = -np.linalg.solve(S, G @ x + g - weight * u)
        step = target - u
        decrease += step @ S @ step
        p = -cost.Q @ cost.goal + A.T @ w + G.T @ (target - K @ x)
        P = cost.Q + A.T @ P @ A + G.T @ K
        P = 0.5 * (P + P.T)
        gains.append(K)
        steps.append(step)
    return np.array(gains[::-1]), np.array(steps[::-1]), max(decrease, 0.0)


def plan(
    model: EagerModel,
    start: tuple[Tensor, Tensor, Tensor],
    cost: Cost,
    horizon: int,
    iterations: int,
) -> tuple[np.ndarray, float, int]:
    """Controls [H, U], their cost, and the number of rollouts."""
    size, controls = len(cost.goal), len(cost.R)
    K, k = np.zeros((horizon, controls, size)), np.zeros((horizon, controls))
    best, reference, expected = np.inf, None, 0.0
    damping, attempt, rollouts = 0.0, 0, 0
    while rollouts < iterations:
        rollouts += 1
        trial = roll_out(model, start, K, k)
        total = cost(trial.states, trial.controls)
        promised = 0.0 if reference is None else ARMIJO * STEP_SIZES[attempt] * expected
        if total < best - promised:
            reference, best, attempt = trial, total, 0
            damping = damping / 10.0 if damping > FIRST_DAMPING else 0.0
        else:
            attempt += 1
            if attempt == len(STEP_SIZES):
                attempt, damping = 0, max(10.0 * damping, FIRST_DAMPING)
        K, step, expected = improved(reference, cost, damping)
        if damping == 0 and expected <= TOLERANCE * abs(best) + ABSOLUTE_TOLERANCE:
            break
        if damping > LAST_DAMPING:
            break
        k = reference.controls + STEP_SIZES[attempt] * step
        k = k - np.einsum("tij,tj->ti", K, reference.states[:-1])
    return reference.controls, best, rollouts
