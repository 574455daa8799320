"""Quadratic costs in relative coordinates: who is where as seen from whom.

Of the nodes of a task, in the order in which they come into contact, the relative coordinates are
each node's state as seen from the next one's, and the last one's as seen from the goal::

    z_1 = x_1 - x_2,  z_2 = x_2 - x_3,  …,  z_M = x_M - x_goal

That is an invertible change of basis, ``z = T (x - goal)``, so that any symmetric positive
semi-definite Q is ``T^T W T`` with some such W, and the other way round. The blocks on W's diagonal
are the *relative terms* and the *goal term*: the costs that tie a gripper to an object, and an
object to its goal, which is the form of the paper's own costs.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def relative_basis(nodes: int, dimension: int) -> np.ndarray:
    """``T`` [m, m] of ``M`` nodes with D degrees of freedom, in `stack_state`'s order."""
    return np.kron(np.eye(nodes) - np.eye(nodes, k=1), np.eye(2 * dimension))


def relative_terms(Q: np.ndarray, dimension: int) -> np.ndarray:
    """``W`` [m, m] of a ``Q`` [m, m]."""
    back = np.linalg.inv(relative_basis(Q.shape[0] // (2 * dimension), dimension))
    return back.T @ np.asarray(Q, dtype=np.float64) @ back


def relative_names(nodes: Sequence[str]) -> tuple[str, ...]:
    """What W's blocks are about, e.g. ``("gripper - target", "target - goal")``."""
    return tuple(f"{a} - {b}" for a, b in zip(nodes, (*nodes[1:], "goal"), strict=True))


def independent_part(W: Float[Array, "m m"], alike: Float[Array, "D D"]) -> Float[Array, "m m"]:
    """The part of W in which terms do not touch each other, nor axes, and alike axes are alike.

    ``alike``: row i averages over the axes that are like axis i (`alike_axes`). It is the
    orthogonal projection onto all W of this form; within a term position and velocity may be tied.
    """
    D = alike.shape[0]
    M = W.shape[0] // (2 * D)
    blocks = W.reshape(M, 2, D, M, 2, D)
    own = jnp.einsum("apdaqd->apqd", blocks) @ alike.T
    return jnp.einsum("apqd,ab,de->apdbqe", own, jnp.eye(M), jnp.eye(D)).reshape(W.shape)


def alike_axes(gravity: np.ndarray | None, dimension: int) -> np.ndarray:
    """[D, D] Row i averages over the axes like axis i: those on which nothing falls are alike."""
    falls = np.zeros(dimension, bool) if gravity is None else np.asarray(gravity) != 0.0
    same = (falls[:, None] == falls[None, :]) & ~(falls[:, None] & falls[None, :])
    same = same | np.eye(dimension, dtype=bool)
    return same / same.sum(axis=1, keepdims=True)
