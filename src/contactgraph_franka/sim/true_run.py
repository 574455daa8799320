"""A recorded run as it really was."""

from dataclasses import replace

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph_franka.sim.truth import Truth


def true_run(truth: Truth, run: Trajectory, began: float) -> Trajectory:
    """``run`` with the true places, velocities and contacts at its states.

    ``began`` s on the reader's clock is when its first state was. A block touches the hand where a
    finger touches it. Raises `InvalidInputError` where the truth of so long ago is no longer kept.
    """
    at = began + run.scene.dt * np.arange(run.steps + 1)
    rows = truth.between(at[0] - 0.1, at[-1] + 0.1)
    if not len(rows) or rows["stamp"][0] > at[0]:
        raise InvalidInputError(f"the truth of {at[0]:.3f} s on is no longer kept")
    # The last tick before each state; what is between two is less than a hundredth of a millimetre.
    index = np.maximum(np.searchsorted(rows["stamp"], at, side="right") - 1, 0)
    late = (at - rows["stamp"][index])[:, None, None]
    velocity = rows["velocity"][index]
    nodes = run.scene.node_count
    contact = np.zeros((len(at), nodes, nodes), bool)
    contact[:, 0, 1:] = contact[:, 1:, 0] = rows["fingers"][index].any(axis=2)
    return replace(
        run,
        position=rows["position"][index] + late * velocity,
        velocity=velocity,
        contact=contact,
        tracked=None,
        measured_at=None,
    )
