"""Affine time-varying LQR: one Riccati recursion, `riccati_pass`, for all problems and operators.

The notation is that of `contactgraph.control.riccati`.
"""

import functools
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
    LQRProblem,
    Operator,
    Products,
    dense_operator,
)
from contactgraph.model import LinearDynamics

_Made = TypeVar("_Made")
_Stage = TypeVar("_Stage")
_Value = TypeVar("_Value")
Value = tuple[Array, Array]
"""P [n, n] and p [n]."""


class QuadraticValue(eqx.Module):
    """``V(x) = x^T P x + 2 p^T x + constant``."""

    P: Float[Array, "*T n n"]
    p: Float[Array, "*T n"]
    constant: Float[Array, "*T"]

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        """The least cost from this state to the end."""
        return x @ self.P @ x + 2.0 * self.p @ x + self.constant


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
    """Decrease of the cost if the dynamics stay as they are; negative where nothing is least."""


def solve_lqr(
    problem: LQRProblem, operator: Operator = dense_operator
) -> tuple[AffinePolicy, QuadraticValue]:
    """The optimal policy, and the value of every state at every step ``0 … H``."""

    def choose(now: Products, step: Array) -> tuple[AffinePolicy, tuple]:
        policy = AffinePolicy(*_minimum(now.S, now.G, now.g))
        return policy, (policy, now.constant + now.g @ policy.k)

    final = problem.Q[-1], problem.q[-1]
    (P, p), (policy, added) = riccati_pass(choose, final, problem, operator(problem.B.shape[1]))
    constant = jnp.append(jax.lax.cumsum(added, reverse=True), 0)
    return policy, QuadraticValue(P, p, constant)


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

    def choose(now: Products, step: Array) -> tuple[AffinePolicy, tuple]:
        x, u = read_stage((states, controls), step)
        weight = damping * jnp.trace(now.S) / u.shape[0]
        S = now.S + weight * jnp.eye(u.shape[0], dtype=u.dtype)
        slope = now.G @ x + now.g - weight * u
        if limits is None:
            K, target = _minimum(S, now.G, slope)
        else:
            target, free = solve_box_qp(S, slope, limits)
            K = -solve_small(free_part(S, free), jnp.where(free[:, None], now.G, 0.0))
        policy = AffinePolicy.around(K, x, target)
        change = target - u
        # V(reference) - V(target) of a quadratic with curvature S and slope at the target.
        half_slope = jnp.sum(S * target, axis=-1) + slope
        decrease = jnp.sum(change * (jnp.sum(S * change, axis=-1) - 2.0 * half_slope))
        return policy, (policy, change, decrease)

    final = problem.Q[-1], problem.q[-1]
    _, (policy, change, decrease) = riccati_pass(
        choose, final, problem, operator(problem.B.shape[1])
    )
    return Improvement(policy, change, jnp.sum(decrease))


def _minimum(S: Array, G: Array, slope: Array) -> tuple[Array, Array]:
    """``-S^-1 G`` and ``-S^-1 slope``."""
    both = -solve_small(S, jnp.concatenate([G, slope[:, None]], axis=1))
    return both[:, :-1], both[:, -1]


def riccati_pass(
    choose: Callable[[Products, Int[Array, ""]], tuple[AffinePolicy, _Made]],
    final: Value,
    problem: LQRProblem,
    operator: DynamicsOperator,
) -> tuple[Value, _Made]:
    """The values under the policy that ``choose`` gives each step, [H+1, …], and its other result.

    P is made symmetric after every few steps: in a loop of its own, since a conditional around P
    would copy it in every step. Steps are read out of the problem's own arrays, of which a slice
    without the last state's cost would be a copy.
    """
    horizon = problem.B.shape[0]
    sizes = [n for n in range(1, horizon + 1) if horizon % n == 0 and n <= operator.symmetric_every]

    def back(after: Value, stage: LQRProblem, step: Array) -> tuple[Value, tuple]:
        now = operator.products(*after, stage)
        policy, made = choose(now, step)
        P = operator.update(now, stage, policy.K, step)
        p = stage.q + now.slope + jnp.sum(now.G * policy.k[:, None], axis=0)
        return (P, p), (after, made)

    def few(after: Value, steps: Array) -> tuple[Value, tuple]:
        read = functools.partial(read_stage, problem)
        (P, p), made = scan_stages(back, after, read, steps, True, operator.reads_ahead)
        return (0.5 * (P + P.swapaxes(0, 1)), p), made

    steps = jnp.arange(horizon).reshape(-1, max(sizes))
    first, made = jax.lax.scan(few, final, steps, reverse=True)
    after, made = jax.tree.map(lambda leaf: leaf.reshape(horizon, *leaf.shape[2:]), made)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, after), made


def scan_stages(
    step: Callable[[_Value, _Stage, Array], tuple[_Value, _Made]],
    value: _Value,
    read: Callable[[Array], _Stage],
    indices: Int[Array, " H"],
    reverse: bool,
    reads_ahead: bool,
) -> tuple[_Value, _Made]:
    """``value, made = step(value, read(index), index)`` along the indices, in one scan.

    XLA fuses the read of a stage into each kernel that uses it. Where that keeps it from
    vectorising these kernels, the loop carries its next stage (``reads_ahead``); for large stages
    the copy costs more.
    """

    def body(carry: tuple, index: Array) -> tuple[tuple, _Made]:
        value, ahead = carry
        value, made = step(value, ahead if reads_ahead else read(index), index)
        # Past the end some valid stage is read, and not used.
        return (value, read(index - 1 if reverse else index + 1) if reads_ahead else None), made

    first = read(indices[-1 if reverse else 0]) if reads_ahead else None
    (value, _), made = jax.lax.scan(body, (value, first), indices, reverse=reverse)
    return value, made


def read_stage(arrays: _Stage, index: Array | int) -> _Stage:
    """The part of every array at this index of its first axis."""

    def part(leaf: Array) -> Array:
        rest = leaf.shape[1:]
        return jax.lax.dynamic_slice(leaf, (index, *[0] * len(rest)), (1, *rest)).reshape(rest)

    return jax.tree.map(part, arrays)


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
