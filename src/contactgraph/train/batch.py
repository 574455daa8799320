"""Windows of the runs as arrays on the device, drawn at random inside the compiled loop."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.data.padding import PaddedRuns
from contactgraph.data.windows import Windows
from contactgraph.model.state import Nodes


class Window(eqx.Module):
    """``L`` steps of a run, or a batch of such with a leading axis.

    Holds no contact labels: training cannot see them.
    """

    position: Float[Array, "*B L+1 N D"]
    """m"""
    velocity: Float[Array, "*B L+1 N D"]
    """m/s"""
    control: Float[Array, "*B L U"]
    """N"""
    nodes: Nodes


class WindowSource(eqx.Module):
    """All runs, and how often each window is to be drawn."""

    position: Float[Array, "R T+1 N D"]
    velocity: Float[Array, "R T+1 N D"]
    control: Float[Array, "R T U"]
    nodes: Nodes
    run: Int[Array, " W"]
    start: Int[Array, " W"]
    cumulative: Float[Array, " W"]
    length: int = eqx.field(static=True)

    def draw(self, count: int, key: PRNGKeyArray) -> Window:
        """`count` windows drawn with the windows' probabilities."""
        uniform = jax.random.uniform(key, (count,))
        drawn = jnp.searchsorted(self.cumulative, uniform * self.cumulative[-1], side="right")
        return self.take(jnp.minimum(drawn, self.run.shape[0] - 1))

    def take(self, window: Int[Array, " B"]) -> Window:
        """The windows of these numbers."""
        run, start = self.run[window], self.start[window]
        states = start[:, None] + jnp.arange(self.length + 1)
        steps = states[:, :-1]
        return Window(
            position=self.position[run[:, None], states],
            velocity=self.velocity[run[:, None], states],
            control=self.control[run[:, None], steps],
            nodes=jax.tree.map(lambda leaf: leaf[run], self.nodes),
        )


def window_source(runs: PaddedRuns, windows: Windows) -> WindowSource:
    """Put runs and windows on the device."""
    return WindowSource(
        position=jnp.asarray(runs.position, jnp.float32),
        velocity=jnp.asarray(runs.velocity, jnp.float32),
        control=jnp.asarray(runs.control, jnp.float32),
        nodes=Nodes(
            actuated=jnp.asarray(runs.actuated),
            mask=jnp.asarray(runs.node_mask),
            candidate=jnp.asarray(runs.candidate),
            anchor=None if runs.anchor is None else jnp.asarray(runs.anchor, jnp.float32),
        ),
        run=jnp.asarray(windows.run),
        start=jnp.asarray(windows.start),
        cumulative=jnp.asarray(windows.probability.cumsum(), jnp.float32),
        length=windows.length,
    )
