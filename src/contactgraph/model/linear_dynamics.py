"""One locally linear step, kept in blocks: one for each node and degree of freedom."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class LinearDynamics(eqx.Module):
    """``x' = A x + B u + offset`` for every node and degree of freedom on its own.

    ``x = [position, velocity]`` of one degree of freedom [m, m/s]; ``u`` [N] reaches every node.
    """

    A: Float[Array, "*T N D 2 2"]
    B: Float[Array, "*T N D 2 U"]
    offset: Float[Array, "*T N D 2"]

    def __call__(
        self,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        control: Float[Array, " U"],
    ) -> tuple[Float[Array, "N D"], Float[Array, "N D"]]:
        """Next position [m] and velocity [m/s]."""
        state = jnp.stack([position, velocity], axis=-1)
        moved = jnp.sum(self.A * state[..., None, :], axis=-1)
        moved = moved + jnp.sum(self.B * control, axis=-1) + self.offset
        return moved[..., 0], moved[..., 1]

    def stacked(self) -> tuple[Array, Array, Array]:
        """Dense ``A [2ND, 2ND]``, ``B [2ND, U]``, ``offset [2ND]`` in `stack_state`'s order."""
        nodes, dimension = self.A.shape[-4:-2]
        lead = self.A.shape[:-4]
        size = 2 * nodes * dimension
        node = jnp.arange(nodes)[:, None, None, None]
        dof = jnp.arange(dimension)[None, :, None, None]
        row = jnp.arange(2)[None, None, :, None]
        column = jnp.arange(2)[None, None, None, :]
        first = (node * 2 + row) * dimension + dof
        second = (node * 2 + column) * dimension + dof
        A = jnp.zeros((*lead, size, size), self.A.dtype).at[..., first, second].set(self.A)
        B = jnp.swapaxes(self.B, -3, -2).reshape(*lead, size, self.B.shape[-1])
        offset = jnp.swapaxes(self.offset, -2, -1).reshape(*lead, size)
        return A, B, offset


def stack_state(
    position: Float[Array, "*T N D"], velocity: Float[Array, "*T N D"]
) -> Float[Array, "*T 2*N*D"]:
    """One vector ``[2ND]``: for each node its D positions [m], then its D velocities [m/s]."""
    both = jnp.stack([position, velocity], axis=-2)
    return both.reshape(*position.shape[:-2], -1)


def unstack_state(
    state: Float[Array, "*T n"], dimension: int
) -> tuple[Float[Array, "*T N D"], Float[Array, "*T N D"]]:
    """Position and velocity back from `stack_state`'s vector."""
    both = state.reshape(*state.shape[:-1], -1, 2, dimension)
    return both[..., 0, :], both[..., 1, :]
