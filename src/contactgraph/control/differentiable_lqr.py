"""The optimal trajectory of an affine LQR problem, and its derivatives by one adjoint solve.

Notation as in `contactgraph.control.lqr`. The optimal ``x, u`` and the costates ``l`` satisfy the
optimality (KKT) conditions, linear with a symmetric matrix (a dash marks the step after)::

    Q x + q + A^T l'  = l        at the end  Q x + q = l
    R u + r + B^T l'  = 0
    A x + B u + offset = x'      x_0 = start

Because that matrix is its own transpose, the derivatives of a loss ``L(x, u)`` come from solving
the same system once more, with ``dL/dx, dL/du`` in the place of ``q, r`` and with zero ``offset``
and ``start`` (Amos et al. 2018, "Differentiable MPC for End-to-end Planning and Control", the
backward pass of LQR). With ``dx, du, dl`` its solution::

    dL/dq, dL/dr       dx, du
    dL/dQ, dL/dR       (dx x^T + x dx^T) / 2, (du u^T + u du^T) / 2
    dL/dA, dL/dB       dl' x^T + l' dx^T, dl' u^T + l' du^T
    dL/doffset         dl'
    dL/dstart          dl_0

The Riccati pass depends on ``A, B, Q, R`` alone, so it is made once, forwards, and kept
(`LQRFactors`); each of the two solves is then two scans of one vector.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.control.control_step import solve_small
from contactgraph.control.lqr import LQRProblem


class LQRTrajectory(eqx.Module):
    """Where an optimally controlled system goes, and what moves it."""

    states: Float[Array, "H+1 n"]
    """m and m/s; the first is the start."""
    controls: Float[Array, "H U"]
    """N"""


class _Factors(eqx.Module):
    """What the Riccati pass leaves: all that depends on ``A, B, Q, R`` alone."""

    P: Float[Array, "H+1 n n"]
    S: Float[Array, "H U U"]
    K: Float[Array, "H U n"]
    closed_loop: Float[Array, "H n n"]
    """``A + B K``"""


class _Slopes(eqx.Module):
    """The right side of the optimality conditions."""

    q: Float[Array, "H+1 n"]
    r: Float[Array, "H U"]
    offset: Float[Array, "H n"]
    start: Float[Array, " n"]


class _Solution(eqx.Module):
    """A solution of the optimality conditions."""

    states: Float[Array, "H+1 n"]
    controls: Float[Array, "H U"]
    costates: Float[Array, "H+1 n"]


def lqr_trajectory(problem: LQRProblem, start: Float[Array, " n"]) -> LQRTrajectory:
    """The states and controls that minimise the problem's cost from ``start`` [n] (m and m/s).

    ``minimise  sum_{t=0..H} (x_t^T Q_t x_t + 2 q_t^T x_t)
    + sum_{t=0..H-1} (u_t^T R_t u_t + 2 r_t^T u_t)``
    with ``x_{t+1} = A_t x_t + B_t u_t + offset_t`` and ``x_0 = start``.

    Differentiable, once and in reverse mode (`jax.grad`, `jax.vjp`), with respect to every leaf of
    the problem and the start, by the rule at the head of this file. ``Q`` and ``R`` must be
    symmetric, and so are their derivatives: those along symmetric changes. Forward mode
    (`jax.jvp`) and second derivatives are not defined and raise JAX's own error.

    One problem with a dense ``A`` [H, n, n]; use `jax.vmap` for a batch, in which any leaf may be
    shared.
    """
    return _trajectory(problem, start)


def tracking_problem(
    A: Float[Array, "H n n"],
    B: Float[Array, "H n U"],
    offset: Float[Array, "H n"],
    Q: Float[Array, "n n"] | Float[Array, "H+1 n n"],
    R: Float[Array, "U U"] | Float[Array, "H U U"],
    goal: Float[Array, " n"] | Float[Array, "H+1 n"],
) -> LQRProblem:
    """The problem that minimises ``sum (x - goal)^T Q (x - goal) + sum u^T R u``.

    ``q = -Q goal`` and ``r = 0``; the cost's constant is left out. What is the same at all steps
    may be given once: ``Q`` [n, n] (1/m^2, s^2/m^2), ``R`` [U, U] (1/N^2), ``goal`` [n] (m, m/s).
    """
    horizon, n, U = B.shape
    q = -jnp.sum(Q * goal[..., None, :], axis=-1)
    return LQRProblem(
        A=A,
        B=B,
        offset=offset,
        Q=jnp.broadcast_to(Q, (horizon + 1, n, n)),
        R=jnp.broadcast_to(R, (horizon, U, U)),
        q=jnp.broadcast_to(q, (horizon + 1, n)),
        r=jnp.zeros((horizon, U), q.dtype),
    )


@jax.custom_vjp
def _trajectory(problem: LQRProblem, start: Array) -> LQRTrajectory:
    return _forward(problem, start)[0]


def _forward(problem: LQRProblem, start: Array) -> tuple[LQRTrajectory, tuple]:
    factors = _factorised(problem)
    slopes = _Slopes(problem.q, problem.r, problem.offset, start)
    solution = _solved(factors, problem.B, slopes)
    trajectory = LQRTrajectory(solution.states, solution.controls)
    return trajectory, (factors, problem.B, solution)


def _backward(kept: tuple, slope: LQRTrajectory) -> tuple[LQRProblem, Array]:
    factors, B, solution = kept
    offset, start = jnp.zeros_like(solution.states[1:]), jnp.zeros_like(solution.states[0])
    adjoint = _solved(factors, B, _Slopes(slope.states, slope.controls, offset, start))
    x, u, after = solution.states[:-1], solution.controls, solution.costates[1:]
    dx, du, dafter = adjoint.states[:-1], adjoint.controls, adjoint.costates[1:]
    problem = LQRProblem(
        A=_outer(dafter, x) + _outer(after, dx),
        B=_outer(dafter, u) + _outer(after, du),
        offset=dafter,
        Q=_symmetric_outer(adjoint.states, solution.states),
        R=_symmetric_outer(du, u),
        q=adjoint.states,
        r=du,
    )
    return problem, adjoint.costates[0]


_trajectory.defvjp(_forward, _backward)


def _factorised(problem: LQRProblem) -> _Factors:
    def back(P: Array, stage: tuple) -> tuple[Array, tuple]:
        A, B, Q, R = stage
        PA, PB = P @ A, P @ B
        S, G = R + B.T @ PB, B.T @ PA
        K = -solve_small(S, G)
        before = Q + A.T @ PA + G.T @ K
        before = 0.5 * (before + before.T)
        return before, (before, S, K)

    Q, final = problem.Q[:-1], problem.Q[-1]
    _, (P, S, K) = jax.lax.scan(back, final, (problem.A, problem.B, Q, problem.R), reverse=True)
    return _Factors(jnp.concatenate([P, final[None]]), S, K, problem.A + problem.B @ K)


def _solved(factors: _Factors, B: Array, slopes: _Slopes) -> _Solution:
    K, M, P = factors.K, factors.closed_loop, factors.P
    pushed = _times(P[1:], slopes.offset)
    c = slopes.q[:-1] + _transpose_times(K, slopes.r) + _transpose_times(M, pushed)
    p = _recursion(M.swapaxes(-1, -2), c, slopes.q[-1], reverse=True)
    slope = slopes.r + _transpose_times(B, p[1:] + pushed)
    k = -jax.vmap(solve_small)(factors.S, slope[..., None])[..., 0]
    states = _recursion(M, _times(B, k) + slopes.offset, slopes.start, reverse=False)
    return _Solution(states, _times(K, states[:-1]) + k, _times(P, states) + p)


def _recursion(matrix: Array, added: Array, first: Array, reverse: bool) -> Array:
    """``y' = matrix y + added`` from ``first``, in time order, the first included."""

    def step(y: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        now = inputs[0] @ y + inputs[1]
        return now, now

    _, rest = jax.lax.scan(step, first, (matrix, added), reverse=reverse)
    return jnp.concatenate([rest, first[None]] if reverse else [first[None], rest])


def _times(matrix: Array, vector: Array) -> Array:
    return jnp.sum(matrix * vector[:, None, :], axis=-1)


def _transpose_times(matrix: Array, vector: Array) -> Array:
    return jnp.sum(matrix * vector[:, :, None], axis=-2)


def _outer(left: Array, right: Array) -> Array:
    return left[:, :, None] * right[:, None, :]


def _symmetric_outer(left: Array, right: Array) -> Array:
    return 0.5 * (_outer(left, right) + _outer(right, left))
