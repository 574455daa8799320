"""Control limits, the box-constrained QP of one control step, and affine policies."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from contactgraph.data.errors import InvalidInputError
from contactgraph.feedback import feedback_control

_UNROLLED_SIZE = 6
_ENUMERATED_SIZE = 4
_SWEEPS = 50
SUMMED_SIZE = 16
"""Up to this many states a sum of products is faster inside a scan than a matrix product."""


def is_known(*values: Any) -> bool:
    """Whether these are numbers, not arrays of a function that JAX traces."""
    return not any(isinstance(each, jax.core.Tracer) for each in values)


class ControlLimits(eqx.Module):
    """Each control stays in ``[lower, upper]``; infinite where it has no limit.

    Raises `InvalidInputError` unless both have one number for each control, none is NaN, and none
    of ``lower`` is above ``upper``.
    """

    lower: Float[Array, " U"] = eqx.field(converter=jnp.asarray)
    """N"""
    upper: Float[Array, " U"] = eqx.field(converter=jnp.asarray)
    """N"""

    def __check_init__(self) -> None:
        lower, upper = self.lower, self.upper
        if lower.ndim != 1 or lower.shape != upper.shape:
            raise InvalidInputError(
                "limits must be one number for each control, lower and upper, found shapes "
                f"{lower.shape} and {upper.shape}"
            )
        if is_known(lower, upper) and not np.all(np.asarray(lower) <= np.asarray(upper)):
            raise InvalidInputError(
                f"limits must be lower <= upper for each control, found {lower} and {upper}"
            )

    def __call__(self, control: Float[Array, "*H U"]) -> Float[Array, "*H U"]:
        """The nearest allowed control."""
        return jnp.clip(control, self.lower, self.upper)


def solve_small(
    matrix: Float[Array, "U U *batch"], right: Float[Array, "U m *batch"]
) -> Float[Array, "U m *batch"]:
    """``matrix^-1 right`` for a small, symmetric positive definite matrix.

    Written out as LDL^T in scalars, which fuse into one kernel: inside a scan a call of LAPACK
    costs more than all the rest of a step. Above six rows the library's Cholesky is used.
    """
    size = matrix.shape[0]
    if size > _UNROLLED_SIZE:
        batch = jnp.broadcast_shapes(matrix.shape[2:], right.shape[2:])
        solve = _solve_by_cholesky
        for _ in batch:
            solve = jax.vmap(solve, in_axes=-1, out_axes=-1)
        return solve(*(jnp.broadcast_to(a, (*a.shape[:2], *batch)) for a in (matrix, right)))
    lower: dict[tuple[int, int], Array] = {}
    pivot: list[Array] = []
    for j in range(size):
        pivot.append(matrix[j, j] - sum(pivot[s] * lower[j, s] ** 2 for s in range(j)))
        for i in range(j + 1, size):
            known = sum(pivot[s] * lower[i, s] * lower[j, s] for s in range(j))
            lower[i, j] = (matrix[i, j] - known) / pivot[j]
    rows: list[Array] = []
    for i in range(size):
        rows.append(right[i] - sum(lower[i, s] * rows[s] for s in range(i)))
    rows = [row / d for row, d in zip(rows, pivot, strict=True)]
    for i in reversed(range(size)):
        rows[i] = rows[i] - sum(lower[s, i] * rows[s] for s in range(i + 1, size))
    return jnp.stack(rows)


def _solve_by_cholesky(matrix: Array, right: Array) -> Array:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)


def free_part(matrix: Float[Array, "U U"], free: Bool[Array, " U"]) -> Float[Array, "U U"]:
    """The matrix on the free controls, the identity on those at a limit, which solving keeps."""
    both = free[:, None] & free[None, :]
    return jnp.where(both, matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


def solve_box_qp(
    S: Float[Array, "U U"], slope: Float[Array, " U"], limits: ControlLimits
) -> tuple[Float[Array, " U"], Bool[Array, " U"]]:
    """``argmin u^T S u + 2 slope^T u`` within limits, and which controls are free of a limit.

    Up to four controls it is exact: all ``3^U`` sets of controls at a limit are solved side by side
    and the best feasible solution is taken, in one small kernel without a data-dependent loop.
    Above, coordinate descent over the controls, which converges.
    """
    if slope.shape[0] <= _ENUMERATED_SIZE:
        u = _best_of_all(S, slope, limits)
    else:
        start = limits(-solve_small(S, slope[:, None])[:, 0])
        u = jax.lax.fori_loop(0, _SWEEPS, lambda _, u: _sweep(S, slope, limits, u), start)
    return u, (u > limits.lower) & (u < limits.upper)


def _best_of_all(S: Array, slope: Array, limits: ControlLimits) -> Float[Array, " U"]:
    # Per control: 0 free, 1 at the lower limit, 2 at the upper one.
    held = np.array(list(itertools.product([0, 1, 2], repeat=slope.shape[0])))
    bound = jnp.where(held == 1, limits.lower, limits.upper)
    fixed = jnp.where(held == 0, 0.0, bound)
    right = jnp.where(held == 0, -slope - jnp.sum(S * fixed[:, None, :], axis=-1), fixed)
    parts = jax.vmap(free_part, in_axes=(None, 0))(S, jnp.asarray(held == 0))
    u = jax.vmap(solve_small)(parts, right[..., None])[..., 0]
    allowed = jnp.all((u >= limits.lower) & (u <= limits.upper), axis=-1)
    value = jnp.sum(u * (jnp.sum(S * u[:, None, :], axis=-1) + 2.0 * slope), axis=-1)
    return u[jnp.argmin(jnp.where(allowed, value, jnp.inf))]


def _sweep(S: Array, slope: Array, limits: ControlLimits, u: Array) -> Float[Array, " U"]:
    """One sweep of coordinate descent."""
    for i in range(u.shape[0]):
        best = u[i] - (jnp.sum(S[i] * u) + slope[i]) / S[i, i]
        u = u.at[i].set(jnp.clip(best, limits.lower[i], limits.upper[i]))
    return u


class AffinePolicy(eqx.Module):
    """``u = K x + k``: affine in the state itself, not in a deviation from a reference.

    One step's policy, or one a step along leading axes. The state has one axis (a flat vector of
    `contactgraph.control.lqr`) or three (``[N, 2, D]``, of a `Plan`). The arrays may be NumPy's.
    """

    K: Float[Array, "..."]
    """[*H, U, *state] N/m and N s/m."""
    k: Float[Array, "*H U"]
    """N"""

    def __call__(
        self, x: Float[Array, "..."], limits: ControlLimits | None = None
    ) -> Float[Array, "*H U"]:
        """The control [N] at states [*H, *state]; within ``limits``, where these are given."""
        control = _control(self.k, self.K, x)
        return control if limits is None else limits(control)

    @classmethod
    def around(
        cls, K: Float[Array, "..."], x: Float[Array, "..."], control: Float[Array, "*H U"]
    ) -> "AffinePolicy":
        """The policy with gains ``K`` that gives ``control`` [N] at ``x`` [*H, *state]."""
        return cls(K, _control(control, K, -x))


def _control(nominal: Any, gains: Any, deviation: Any) -> Any:
    """`feedback_control` [*H, U] N for states of any number of axes."""
    K, x = gains.reshape(*nominal.shape, -1), deviation.reshape(*nominal.shape[:-1], -1)
    return feedback_control(nominal, K, x, _product)


def _product(K: Any, x: Any) -> Any:
    # In a compiled scan a sum fuses with the operations around it, but a long one is slow.
    if x.shape[-1] <= SUMMED_SIZE:
        return (K * x[..., None, :]).sum(-1)
    return (K @ x[..., None])[..., 0]
