"""What acts on an arm's joints besides its motors, told apart into friction and load."""

import numpy as np

from contactgraph_franka.driver.arm import JOINTS, ArmState

_SLIDING = 0.02
"""rad/s: well above it a joint slides, well below it sticks."""


class OuterTorque:
    r"""A momentum observer (De Luca and Mattone 2003) that knows of dry friction.

    What the last tick's motion tells of the torques $\tau_o$ besides the motors',

    $$ \tau_o = M \frac{\Delta \dot q}{\Delta t} + h - \tau, $$

    is low-passed. Of it, dry friction is what friction can be: a joint that slides with velocity
    $\dot q$ has $-f \tanh(\dot q / v)$; one that sticks has whatever keeps it there, up to
    :math:`\pm f`. The rest is load. So a load is felt, and friction, once known, cancelled.
    """

    def __init__(self, friction: np.ndarray, filter_time: float) -> None:
        """``friction`` [7] N m, dry; ``filter_time`` s is the estimates' time constant."""
        self._friction = friction
        self._filter_time = filter_time
        self.reset()

    def reset(self) -> None:
        """Nothing is known any more."""
        self.total = np.zeros(JOINTS)
        """[7] N m: all that acts besides the motors."""
        self.load = np.zeros(JOINTS)
        """[7] N m: what of it friction cannot be."""
        self._sliding = np.zeros(JOINTS)
        self._last: ArmState | None = None

    def observe(self, state: ArmState, inertia: np.ndarray, bias: np.ndarray) -> None:
        """Takes in a new state. ``inertia`` [7, 7] kg m^2; ``bias`` [7] N m, velocity's torques.

        A state that is not newer than the last one changes nothing.
        """
        last, self._last = self._last, state
        if last is None or state.time <= last.time:
            return
        duration = state.time - last.time
        weight = duration / (self._filter_time + duration)
        velocity = state.joint_velocity
        torque = inertia @ ((velocity - last.joint_velocity) / duration) + bias - state.torque
        self.total = self.total + weight * (torque - self.total)
        self._sliding += weight * (np.tanh(velocity / _SLIDING) - self._sliding)
        slides = -self._friction * self._sliding
        sticks = self._friction * (1.0 - np.abs(self._sliding))
        friction = np.minimum(np.maximum(self.total, slides - sticks), slides + sticks)
        self.load = self.total - friction
