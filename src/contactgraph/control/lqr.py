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

A `DynamicsOperator` multiplies by A: one function argument makes the recursion dense or block
diagonal.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.control.box_qp import (
    AffinePolicy,
    ControlLimits,
    free_part,
    solve_box_qp,
    solve_small,
)
from contactgraph.control.cost import QuadraticCost
from contactgraph.control.riccati import (
    DynamicsOperator,
    Operator,
    Products,
    dense_operator,
    dense_product,
)
from contactgraph.model import LinearDynamics

_Arrays = TypeVar("_Arrays")


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
    """[H, n, n], or as the `DynamicsOperator` stores it."""
    B: Float[Array, "H n U"]
    offset: Float[Array, "H n"]
    Q: Float[Array, "H+1 n n"]
    R: Float[Array, "H U U"]
    q: Float[Array, "H+1 n"]
    r: Float[Array, "H U"]


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


class Improvement(eqx.Module):
    """A policy around a reference, and the decrease of the cost that it promises."""

    policy: AffinePolicy
    step: Float[Array, "H U"]
    """N, the policy's change of the reference's control at the reference's state."""
    expected_decrease: Float[Array, ""]
    """Decrease of the cost if the dynamics stay as they are; never negative."""


class _ControlProblem(eqx.Module):
    """Cost-to-go of one step as a function of u and x."""

    S: Float[Array, "U U"]
    g: Float[Array, " U"]
    products: Products


def solve_lqr(
    problem: LQRProblem, operator: Operator = dense_operator, which: tuple[Int[Array, ""], ...] = ()
) -> tuple[AffinePolicy, QuadraticValue]:
    """The optimal policy, and the value of every state at every step ``0 … H``.

    ``which`` of many, where every array has leading axes for these indices. In `jax.lax.map` over
    an index each problem is read where it is, while a map over problems would copy it first.
    """
    horizon, size = problem.B.shape[len(which) : len(which) + 2]
    riccati = operator(size)

    def back(carry: tuple, stage: LQRProblem, step: Array) -> tuple[tuple, tuple]:
        P, p, constant = carry
        now = _control_problem(P, p, stage, riccati)
        both = -solve_small(now.S, jnp.concatenate([now.products.G, now.g[:, None]], axis=1))
        policy = AffinePolicy(both[:, :-1], both[:, -1])
        constant = constant + stage.offset @ (now.products.w + p) + now.g @ policy.k
        P, p = _before(now, stage, policy, step, riccati)
        return (P, p, constant), (policy, QuadraticValue(P, p, constant))

    Q, q = _at((problem.Q, problem.q), (*which, horizon))
    final = QuadraticValue(Q, q, jnp.zeros((), Q.dtype))
    carry = (final.P, final.p, final.constant)
    policy, values = _backwards(back, carry, problem, riccati, horizon, which)
    appended = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), values, final)
    return policy, appended


def improve_policy(
    problem: LQRProblem,
    states: Float[Array, "H n"],
    controls: Float[Array, "H U"],
    damping: Float[Array, ""],
    limits: ControlLimits | None,
    operator: Operator = dense_operator,
) -> Improvement:
    """The optimal policy near a reference: limits are judged at its states.

    ``damping`` (Levenberg; relative to the mean curvature of ``S``) adds
    ``damping * trace(S)/U * |u - reference|^2`` to each step's cost, so that a larger one answers
    with a smaller step and the reference itself costs what it did.
    """
    riccati = operator(problem.B.shape[1])

    def back(carry: tuple, stage: LQRProblem, index: Array) -> tuple[tuple, tuple]:
        P, p = carry
        x, u = _at((states, controls), (index,))
        now = _control_problem(P, p, stage, riccati)
        G = now.products.G
        weight = damping * jnp.trace(now.S) / u.shape[0]
        S = now.S + weight * jnp.eye(u.shape[0], dtype=u.dtype)
        slope = G @ x + now.g - weight * u
        if limits is None:
            both = -solve_small(S, jnp.concatenate([G, slope[:, None]], axis=1))
            K, target = both[:, :-1], both[:, -1]
        else:
            target, free = solve_box_qp(S, slope, limits)
            K = -solve_small(free_part(S, free), jnp.where(free[:, None], G, 0.0))
        policy = AffinePolicy.around(K, x, target)
        step = target - u
        # V(reference) - V(target) of a quadratic with curvature S and slope at the target.
        half_slope = jnp.sum(S * target, axis=-1) + slope
        decrease = jnp.sum(step * (jnp.sum(S * step, axis=-1) - 2.0 * half_slope))
        return _before(now, stage, policy, index, riccati), (policy, step, decrease)

    carry = (problem.Q[-1], problem.q[-1])
    policy, step, decrease = _backwards(back, carry, problem, riccati, len(controls))
    return Improvement(policy, step, jnp.maximum(jnp.sum(decrease), 0.0))


def _backwards(
    back: Callable[[tuple, LQRProblem, Array], tuple[tuple, tuple]],
    carry: tuple,
    problem: LQRProblem,
    operator: DynamicsOperator,
    horizon: int,
    which: tuple[Array, ...] = (),
) -> tuple:
    """``back`` from the last step to the first; its other results, [H, …].

    The carry begins with P, which is made symmetric after every few steps: in a loop of its own,
    since a conditional around P would copy it in every step. Steps are read out of the problem's
    own arrays, of which a slice without the last state's cost would be a copy.
    """
    few = max(size for size in range(1, operator.symmetric_every + 1) if horizon % size == 0)

    def step(carry: tuple, index: Array) -> tuple[tuple, tuple]:
        return back(carry, _at(problem, (*which, index)), index)

    def steps(carry: tuple, indices: Array) -> tuple[tuple, tuple]:
        (P, *rest), made = jax.lax.scan(step, carry, indices, reverse=True)
        return (0.5 * (P + P.T), *rest), made

    indices = jnp.arange(horizon).reshape(-1, few)
    made = jax.lax.scan(steps, carry, indices, reverse=True)[1]
    return jax.tree.map(lambda leaf: leaf.reshape(horizon, *leaf.shape[2:]), made)


def _at(arrays: _Arrays, index: tuple[Array | int, ...]) -> _Arrays:
    """The part of every array at these indices of its first axes."""

    def part(leaf: Array) -> Array:
        rest = leaf.shape[len(index) :]
        begin = (*index, *[0] * len(rest))
        return jax.lax.dynamic_slice(leaf, begin, (*[1] * len(index), *rest)).reshape(rest)

    return jax.tree.map(part, arrays)


def _control_problem(
    P: Array, p: Array, stage: LQRProblem, operator: DynamicsOperator
) -> _ControlProblem:
    products = operator.products(P, p, stage.A, stage.B, stage.offset)
    slopes = dense_product(stage.B, jnp.concatenate([products.PB, products.w[:, None]], axis=1))
    return _ControlProblem(stage.R + slopes[:, :-1], stage.r + slopes[:, -1], products)


def _before(
    now: _ControlProblem,
    stage: LQRProblem,
    policy: AffinePolicy,
    step: Int[Array, ""],
    operator: DynamicsOperator,
) -> tuple[Array, Array]:
    """P and p of this step."""
    P = operator.update(now.products, stage.A, stage.Q, policy.K, step)
    return P, stage.q + now.products.slope + jnp.sum(now.products.G * policy.k[:, None], axis=0)


def block_state(
    position: Float[Array, "N D"], velocity: Float[Array, "N D"], node_ids: Int[Array, " M"]
) -> Float[Array, " m"]:
    """All positions of the M nodes, then all their velocities: the order of `block_operator`."""
    return jnp.stack([position[node_ids], velocity[node_ids]]).reshape(-1)


def block_dynamics(
    dynamics: LinearDynamics,
) -> tuple[Float[Array, "H 2 2 k"], Float[Array, "H m U"], Float[Array, "H m"]]:
    """``A, B, offset`` of [H, M, D, …] dynamics, as `block_operator` takes them; ``k = MD``."""
    horizon, U = dynamics.B.shape[0], dynamics.B.shape[-1]
    A = jnp.moveaxis(dynamics.A.reshape(horizon, -1, 2, 2), 1, -1)
    B = jnp.moveaxis(dynamics.B.reshape(horizon, -1, 2, U), 2, 1)
    offset = jnp.moveaxis(dynamics.offset.reshape(horizon, -1, 2), 2, 1)
    return A, B.reshape(horizon, -1, U), offset.reshape(horizon, -1)


def block_cost(
    cost: QuadraticCost, node_ids: Int[Array, " M"], dimension: int, horizon: int
) -> QuadraticCost:
    """The cost on the M nodes in `block_state`'s order, one matrix a step."""
    Q, R, goal = cost.over(horizon)
    part = jnp.arange(2)[:, None, None]
    index = ((2 * node_ids[:, None] + part) * dimension + jnp.arange(dimension)).reshape(-1)
    return QuadraticCost(Q[:, index[:, None], index[None, :]], R, goal[:, index])


def block_gains(K: Float[Array, "H U N 2 D"], node_ids: Int[Array, " M"]) -> Float[Array, "H U m"]:
    """The gains on the M nodes in `block_state`'s order."""
    return jnp.moveaxis(K[:, :, node_ids], 3, 2).reshape(*K.shape[:2], -1)


def node_gains(
    gains: Float[Array, "H U m"], node_ids: Int[Array, " M"], like: Float[Array, "N D"]
) -> Float[Array, "H U N 2 D"]:
    """`block_gains` turned back; zero on nodes without a cost."""
    count, dimension = like.shape
    by_node = jnp.moveaxis(gains.reshape(*gains.shape[:2], 2, -1, dimension), 2, 3)
    whole = jnp.zeros((*gains.shape[:2], count, 2, dimension), gains.dtype)
    return whole.at[:, :, node_ids].set(by_node)
