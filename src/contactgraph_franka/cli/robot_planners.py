"""Planners that commands run in a process of their own: made there, from what is sent there."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from contactgraph_franka.loop import Planner

_NOWHERE = np.zeros(3)
"""m: each run has its own goal."""
_CONTROL_WEIGHT = 0.03
"""1/N^2. With the simulated task's 0.01, plans that far ahead begin with more force than an arm's
limits let pass, more along one axis than along another: the hand comes to the block on a bow."""


def mpc_planner(path: Path, max_force: float, horizon: int, infer_contacts: bool) -> Planner:
    """MPC with the model in the file ``path``, for the arm's pickup; forces up to ``max_force`` N.

    Raises `InvalidInputError` where there is no such model, or it is for something else.
    """
    from contactgraph.data import InvalidInputError
    from contactgraph.evaluate.mpc_policy import TaskCost
    from contactgraph.model import ContactDynamics, MotionNoise
    from contactgraph.model.io import load_model
    from contactgraph_franka.envs.pickup import pickup_cost, pickup_scene
    from contactgraph_franka.loop.mpc_planner import MPCPlanner

    model = load_model(path).model
    if not isinstance(model, ContactDynamics):
        raise InvalidInputError(f"{path}: must be a model of contacts to control an arm with")
    return MPCPlanner(
        model,
        pickup_scene(model.dt, _NOWHERE),
        TaskCost.of(replace(pickup_cost(), control_weight=_CONTROL_WEIGHT), len(_NOWHERE)),
        max_force,
        horizon=horizon,
        motion_noise=MotionNoise() if infer_contacts else None,
    )


def expert_planner(noise: float) -> Planner:
    """The scripted expert of the arm's pickup, with ``noise`` N on its force."""
    from contactgraph.envs import FrankaExpert
    from contactgraph_franka.envs.pickup import pickup_scene
    from contactgraph_franka.loop.policy_planner import PolicyPlanner

    return PolicyPlanner(FrankaExpert(noise=noise), pickup_scene(0.01, _NOWHERE))
