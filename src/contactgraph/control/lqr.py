"""Affine time-varying LQR: one Riccati pass, backwards in one scan.

Notation, at one step (t is left out; a dash marks the step after)::

    x, u      state [n], control [U]
    x' = A x + B u + offset
    cost      x^T Q x + 2 q^T x + u^T R u + 2 r^T u, and at the end x^T Q x + 2 q^T x
    V(x)      x^T P x + 2 p^T x + constant, the least cost from here on
    w         P' offset + p'
    S         R + B^T P' B          curvature of the cost-to-go along u
    G         B^T P' A              how its slope along u moves with x
    g         r + B^T w             its slope along u at x = 0, u = 0
    K, k      -S^-1 G, -S^-1 g      the best control is u = K x + k
    P         Q + A^T P' A + G^T K
    p         q + A^T w + G^T k

With controls held at a limit, their rows of K are zero and the same two last lines hold, since
``K^T (S K + G) = 0`` and ``K^T (S k + g) = 0`` still do.

The only product with A is ``A^T X`` (P is symmetric), so one function argument makes the pass
dense or block diagonal.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.control.control_step import (
    ControlLimits,
    bounded_minimum,
    free_part,
    solve_small,
)

TransposeProduct = Callable[[Array, Float[Array, "n m"]], Float[Array, "n m"]]
"""``A^T X`` from one step's A, however that is stored, and ``X``."""


_SUMMED_SIZE = 16
"""Up to so many states a matrix product is written as a sum of products: inside a scan XLA then
makes one kernel of it and of what is around it, while a call of a matrix product costs more than
all the rest of a step."""


class LQRPolicy(eqx.Module):
    """``u = K x + k``: affine in the state itself, not in a deviation from a reference."""

    K: Float[Array, "*H U n"]
    """N/m and N s/m."""
    k: Float[Array, "*H U"]
    """N"""

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " U"]:
        """The control [N] of one step's policy at a state."""
        return self.K @ x + self.k


class QuadraticValue(eqx.Module):
    """``V(x) = x^T P x + 2 p^T x + constant``."""

    P: Float[Array, "*T n n"]
    p: Float[Array, "*T n"]
    constant: Float[Array, "*T"]

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        """The least cost from this state to the end."""
        return x @ self.P @ x + 2.0 * self.p @ x + self.constant


class LQRProblem(eqx.Module):
    """Dynamics and cost of all steps, in the notation at the head of this file."""

    A: Float[Array, "H ..."]
    """[H, n, n], or whatever the `TransposeProduct` in use understands."""
    B: Float[Array, "H n U"]
    offset: Float[Array, "H n"]
    Q: Float[Array, "H+1 n n"]
    R: Float[Array, "H U U"]
    q: Float[Array, "H+1 n"]
    r: Float[Array, "H U"]


class Improvement(eqx.Module):
    """A policy around a reference, and what it promises."""

    policy: LQRPolicy
    step: Float[Array, "H U"]
    """What the policy would add to the reference's control at the reference's state, N."""
    expected_decrease: Float[Array, ""]
    """By how much the cost falls if the dynamics stay as they are; never negative."""


class _ControlProblem(eqx.Module):
    """Cost-to-go of one step as a function of u and x."""

    S: Float[Array, "U U"]
    G: Float[Array, "U n"]
    g: Float[Array, " U"]
    P: Float[Array, "n n"]
    """``Q + A^T P' A``: before the control's part is taken off."""
    p: Float[Array, " n"]
    w: Float[Array, " n"]


def dense_product(A: Float[Array, "n n"], X: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """``A^T X`` for a dense A."""
    if A.shape[0] > _SUMMED_SIZE:
        return A.T @ X
    return jnp.sum(A[:, :, None] * X[:, None, :], axis=0)


def _product(X: Float[Array, "n k"], Y: Float[Array, "k m"]) -> Float[Array, "n m"]:
    if X.shape[1] > _SUMMED_SIZE:
        return X @ Y
    return jnp.sum(X[:, :, None] * Y, axis=1)


def solve_lqr(
    problem: LQRProblem, transpose_product: TransposeProduct = dense_product
) -> tuple[LQRPolicy, QuadraticValue]:
    """The optimal policy, and the value of every state at every step ``0 … H``."""

    def back(value: QuadraticValue, stage: LQRProblem) -> tuple[QuadraticValue, tuple]:
        now = _control_problem(value.P, value.p, stage, transpose_product)
        both = -solve_small(now.S, jnp.concatenate([now.G, now.g[:, None]], axis=1))
        policy = LQRPolicy(both[:, :-1], both[:, -1])
        constant = value.constant + stage.offset @ (now.w + value.p) + now.g @ policy.k
        before = QuadraticValue(*_before(now, policy), constant)
        return before, (policy, before)

    final = QuadraticValue(problem.Q[-1], problem.q[-1], jnp.zeros((), problem.Q.dtype))
    _, (policy, values) = jax.lax.scan(back, final, _stages(problem), reverse=True)
    appended = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), values, final)
    return policy, appended


def improve_policy(
    problem: LQRProblem,
    states: Float[Array, "H n"],
    controls: Float[Array, "H U"],
    damping: Float[Array, ""],
    limits: ControlLimits | None,
    transpose_product: TransposeProduct = dense_product,
) -> Improvement:
    """The optimal policy near a reference: limits are judged at its states.

    ``damping`` (Levenberg; relative to the mean curvature of ``S``) adds
    ``damping * trace(S)/U * |u - reference|^2`` to each step's cost, so that a larger one answers
    with a smaller step and the reference itself costs what it did.
    """

    def back(value: tuple[Array, Array], inputs: tuple) -> tuple[tuple[Array, Array], tuple]:
        stage, x, u = inputs
        now = _control_problem(*value, stage, transpose_product)
        weight = damping * jnp.trace(now.S) / u.shape[0]
        S = now.S + weight * jnp.eye(u.shape[0], dtype=u.dtype)
        slope = now.G @ x + now.g - weight * u
        if limits is None:
            both = -solve_small(S, jnp.concatenate([now.G, slope[:, None]], axis=1))
            K, target = both[:, :-1], both[:, -1]
        else:
            target, free = bounded_minimum(S, slope, limits)
            K = -solve_small(free_part(S, free), jnp.where(free[:, None], now.G, 0.0))
        policy = LQRPolicy(K, target - K @ x)
        step = target - u
        # V(reference) - V(target) of a quadratic with curvature S and slope at the target.
        half_slope = jnp.sum(S * target, axis=-1) + slope
        decrease = jnp.sum(step * (jnp.sum(S * step, axis=-1) - 2.0 * half_slope))
        return _before(now, policy), (policy, step, decrease)

    final = (problem.Q[-1], problem.q[-1])
    _, (policy, step, decrease) = jax.lax.scan(
        back, final, (_stages(problem), states, controls), reverse=True
    )
    return Improvement(policy, step, jnp.maximum(jnp.sum(decrease), 0.0))


def _stages(problem: LQRProblem) -> LQRProblem:
    """The problem without its last state cost: H stages."""
    return LQRProblem(
        problem.A,
        problem.B,
        problem.offset,
        problem.Q[:-1],
        problem.R,
        problem.q[:-1],
        problem.r,
    )


def _control_problem(
    P: Array, p: Array, stage: LQRProblem, transpose_product: TransposeProduct
) -> _ControlProblem:
    size = P.shape[0]
    # Products with the same matrix are taken together: in a scan of small steps it is the
    # number of operations that costs, not their size.
    onward = _product(P, jnp.concatenate([stage.B, stage.offset[:, None]], axis=1))
    PB, w = onward[:, :-1], onward[:, -1] + p
    onward = jnp.concatenate([PB, w[:, None]], axis=1)
    pulled = transpose_product(stage.A, jnp.concatenate([P, onward], axis=1))
    slopes = dense_product(stage.B, onward)
    return _ControlProblem(
        S=stage.R + slopes[:, :-1],
        G=pulled[:, size:-1].T,
        g=stage.r + slopes[:, -1],
        P=stage.Q + transpose_product(stage.A, pulled[:, :size].T),
        p=stage.q + pulled[:, -1],
        w=w,
    )


def _before(now: _ControlProblem, policy: LQRPolicy) -> tuple[Array, Array]:
    """P and p of this step, P symmetric to the last bit."""
    P = now.P + dense_product(now.G, policy.K)
    return 0.5 * (P + P.T), now.p + jnp.sum(now.G * policy.k[:, None], axis=0)
