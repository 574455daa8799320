"""A plan as a law: what to do at any time within it, wherever things have got to."""

import numpy as np

from contactgraph.control import Plan
from contactgraph.evaluate.plan_tracking import present
from contactgraph_franka.loop.laws import FeedbackLaw


def plan_feedback(plan: Plan, dt: float, capacity: int) -> FeedbackLaw:
    """The law of a plan with steps of ``dt`` s, padded to a ``capacity`` of nodes.

    ReadingBuilder that are not in play have no say in it.
    """
    who, slots = present(plan, capacity)
    count, horizon = len(plan.who), len(plan.controls)
    states = np.asarray(plan.states, float).reshape(horizon + 1, count, 2, -1)
    gains = np.asarray(plan.policy.K, float).reshape(horizon, -1, count, 2 * states.shape[-1])
    all_states = np.zeros((horizon + 1, capacity, *states.shape[2:]))
    all_gains = np.zeros((*gains.shape[:2], capacity, gains.shape[-1]))
    all_states[:, who], all_gains[:, :, who] = states[:, slots], gains[:, :, slots]
    return FeedbackLaw(
        states=all_states,
        controls=np.asarray(plan.controls, float),
        gains=all_gains.reshape(*gains.shape[:2], -1),
        dt=dt,
    )
