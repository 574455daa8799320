"""The smallest problem of control: the best control of one step, within its limits."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

_UNROLLED_SIZE = 6


class ControlLimits(eqx.Module):
    """Each control stays in ``[lower, upper]``."""

    lower: Float[Array, " U"]
    """N"""
    upper: Float[Array, " U"]
    """N"""

    def __call__(self, control: Float[Array, "*H U"]) -> Float[Array, "*H U"]:
        """The nearest allowed control."""
        return jnp.clip(control, self.lower, self.upper)


def solve_small(matrix: Float[Array, "U U"], right: Float[Array, "U m"]) -> Float[Array, "U m"]:
    """``matrix^-1 right`` for a small, symmetric positive definite matrix.

    Written out as LDL^T in scalars, which fuse into one kernel: inside a scan a call of LAPACK
    costs more than all the rest of a step. Above six rows the library's Cholesky is used.
    """
    size = matrix.shape[0]
    if size > _UNROLLED_SIZE:
        return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)
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


def free_part(matrix: Float[Array, "U U"], free: Bool[Array, " U"]) -> Float[Array, "U U"]:
    """The matrix on the free controls, the identity on those held: solving leaves these alone."""
    both = free[:, None] & free[None, :]
    return jnp.where(both, matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


def bounded_minimum(
    S: Float[Array, "U U"],
    slope: Float[Array, " U"],
    limits: ControlLimits,
    start: Float[Array, " U"],
) -> tuple[Float[Array, " U"], Bool[Array, " U"]]:
    """``argmin u^T S u + 2 slope^T u`` within limits, and which controls no limit holds.

    Projected Newton (Bertsekas 1982; Tassa et al. 2014 for its use here) with a fixed number of
    rounds; with few controls the set of those held settles in as many.
    """
    u = limits(start)
    for _ in range(2 * u.shape[0]):
        gradient, free = _gradient(S, slope, limits, u)
        step = solve_small(free_part(S, free), jnp.where(free, gradient, 0.0)[:, None])[:, 0]
        u = limits(u - step)
    return u, _gradient(S, slope, limits, u)[1]


def _gradient(
    S: Array, slope: Array, limits: ControlLimits, u: Array
) -> tuple[Float[Array, " U"], Bool[Array, " U"]]:
    """Half the gradient, and which controls are free to follow it."""
    gradient = jnp.sum(S * u, axis=-1) + slope
    held = ((u <= limits.lower) & (gradient > 0)) | ((u >= limits.upper) & (gradient < 0))
    return gradient, ~held
