"""Affine feedback policies."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from contactgraph.control.box_qp import ControlLimits


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
        control = _product(self.K, x, self.K.ndim - self.k.ndim) + self.k
        return control if limits is None else limits(control)

    @classmethod
    def around(
        cls, K: Float[Array, "..."], x: Float[Array, "..."], control: Float[Array, "*H U"]
    ) -> "AffinePolicy":
        """The policy with gains ``K`` that gives ``control`` [N] at ``x`` [*H, *state]."""
        return cls(K, control - _product(K, x, K.ndim - control.ndim))


def _product(K: Any, x: Any, axes: int) -> Any:
    # A sum rather than a matrix product: in a compiled scan it fuses with what is around it.
    begin = x.ndim - axes
    return (K * x.reshape(*x.shape[:begin], 1, *x.shape[begin:])).sum(tuple(range(-axes, 0)))
