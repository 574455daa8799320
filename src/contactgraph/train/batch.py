"""Windows of the runs as arrays on the device, drawn at random inside the compiled loop."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.data.padding import PaddedRuns
from contactgraph.data.windows import Windows
from contactgraph.model.state import Nodes

_RUNS = 256


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
    """Put runs and windows on the device.

    Runs are padded to a multiple of `_RUNS`, and windows as if every run had the longest one's:
    compiling a training takes longer than many a training, and like this another number of runs
    compiles nothing anew. Padding has no probability.
    """
    count, steps = runs.control.shape[:2]
    more_runs = -count % _RUNS
    most = (count + more_runs) * (steps - windows.length + 1)

    def padded(values: np.ndarray, dtype: DTypeLike) -> Array:
        # What is there is repeated: even a draw that rounding leads astray is a real one.
        return jnp.asarray(np.take(values, np.arange(count + more_runs) % count, axis=0), dtype)

    drawn = np.arange(most) % len(windows.run)
    cumulative = np.ones(most)
    cumulative[: len(windows.run)] = windows.probability.cumsum() / windows.probability.sum()
    return WindowSource(
        position=padded(runs.position, jnp.float32),
        velocity=padded(runs.velocity, jnp.float32),
        control=padded(runs.control, jnp.float32),
        nodes=Nodes(
            actuated=padded(runs.actuated, bool),
            mask=padded(runs.node_mask, bool),
            candidate=padded(runs.candidate, bool),
            anchor=None if runs.anchor is None else padded(runs.anchor, jnp.float32),
        ),
        run=jnp.asarray(windows.run[drawn]),
        start=jnp.asarray(windows.start[drawn]),
        cumulative=jnp.asarray(cumulative, jnp.float32),
        length=windows.length,
    )
