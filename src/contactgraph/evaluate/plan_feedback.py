"""A plan as a law: what to do at any time within it, wherever things have got to."""

import numpy as np

from contactgraph.control import Plan
from contactgraph.robot.loop.laws import FeedbackLaw


def plan_feedback(plan: Plan, dt: float, capacity: int) -> FeedbackLaw:
    """The law of a plan with steps of ``dt`` s, padded to a ``capacity`` of nodes."""
    states = np.asarray(plan.states, float)
    return FeedbackLaw(
        states=states.reshape(len(states), capacity, 2, -1),
        controls=np.asarray(plan.controls, float),
        gains=np.asarray(plan.policy.K, float),
        dt=dt,
    )
