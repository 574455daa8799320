"""A contact sensor of one's own that fails: it sticks at its last report for a while.

Usage: python examples/extend_sensor_fault.py
In this folder also: contactgraph control pickup pickup --fault extend_sensor_fault:Sticking
"""

import numpy as np

import contactgraph
from contactgraph.evaluate import control_task
from contactgraph.model import motion_noise
from contactgraph.policies import SensorFault, task_policy


class Sticking(SensorFault):
    """At every step it may begin to repeat its last report, for ten steps."""

    def begin(self, scene, number):
        """See `SensorFault`; ``number`` makes the failures of an episode its own."""
        rng, left, last = np.random.default_rng(number), 0, None

        def report(contact):
            nonlocal left, last
            left = 10 if left == 0 and rng.random() < 0.2 else max(0, left - 1)
            last = contact if left == 0 or last is None else last
            return last

        return report


if __name__ == "__main__":
    model, task = contactgraph.load("pickup"), contactgraph.make("pickup")
    for noise, name in ((None, "alone"), (motion_noise(model), "and motion")):
        policy = task_policy(model, task, faults=Sticking(), motion_noise=noise)
        estimated = control_task(policy, task, 3, seed=0).metrics.estimated
        print(f"contact estimate by the sticking sensor {name}: F1 {estimated.edges.f1:.3f}")
