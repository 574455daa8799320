"""A recorded run with what the model believed and inferred along it, ready to be drawn."""

import numpy as np

from contactgraph.data import Trajectory
from contactgraph.evaluate import model_diagnostics
from contactgraph.model import ContactDynamics
from contactgraph.viz import SceneRun


def scene_run(
    model: ContactDynamics, name: str, run: Trajectory, plan: np.ndarray | None = None
) -> SceneRun:
    """The run as the model sees it step by step, its belief corrected by measured contacts.

    `plan` is [T, H+1, N, D] m, where a controller planned the nodes to be.
    """
    insight = model_diagnostics(model, run)
    parameters = insight.parameters
    if parameters is None:
        return SceneRun.from_trajectory(name, run, insight.edges, insight.belief, plan=plan)
    return SceneRun.from_trajectory(
        name,
        run,
        insight.edges,
        insight.belief,
        inverse_mass=np.asarray(parameters.inverse_mass),
        stiffness=np.asarray(parameters.stiffness_rate),
        damping=np.asarray(parameters.damping_rate),
        plan=plan,
    )
