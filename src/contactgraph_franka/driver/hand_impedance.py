"""The hand as a mass that keeps its orientation, from what any client of an arm tells."""

import math
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.driver.arm import JOINTS, TICK, ArmState, JointDrives, JointLimits
from contactgraph_franka.driver.hand_motion import bias_acceleration, rotation_between
from contactgraph_franka.driver.outer_torque import OuterTorque

APPARENT_MASS = 4.0
"""kg, what the hand feels like to a force: about what the arm weighs there."""
FILTER_TIME = 0.004
"""s, of what acts from outside. An arm whose joint velocities are noisy may need more."""
ROTATION_STIFFNESS = 8.0
"""N m/rad"""
ROTATION_DAMPING = 2.0 * math.sqrt(ROTATION_STIFFNESS)
"""N m s/rad"""
_REACH = 0.005
"""s: how far ahead the rotation is damped. Without it, 6 N m s/rad on a hand of 0.002 kg m^2 about
its own axis would swing up under two ticks of delay."""
_RATE_SHARE = ROTATION_DAMPING + _REACH * ROTATION_STIFFNESS
_TURN_SHARE = _REACH * _RATE_SHARE
_POSTURE_STIFFNESS = 10.0
_POSTURE_DAMPING = 4.0
_UNIT = np.eye(3)


@dataclass(slots=True)
class HandCommand:
    """What the joints are to do, and what that is worth at the hand."""

    torque: np.ndarray
    """[7] N m, without what holds the arm's weight."""
    force: np.ndarray
    """[3] N: as much of the force that was asked for as limits left."""


class HandImpedance:
    r"""Torques with which the hand moves as a mass of 4 kg under a force, orientation held.

    Impedance control with the inertia shaped (Hogan 1985; Khatib 1987). With J the Jacobian of the
    grasp point, M the inertia of links and drives, $\Lambda = (J M^{-1} J^T)^{-1}$, h the Coriolis
    and damping torques, $\hat\tau$ what acts on the joints besides (`OuterTorque`), $\hat f$ the
    load on the hand in it, and $\tau_0$ what draws the elbow home without moving the hand,

    $$ \tau = J^T \Lambda (a - \dot J \dot q) + h - \hat\tau + \tau_0, \qquad
       a = \big( (u + \hat f) / m,\; \text{stiffness and damping of the rotation} \big). $$

    The rotation's spring and damper are those a few ticks ahead (as in an implicit Euler step), so
    that directions in which the hand is light are held no faster than the loop can follow.

    Where a joint's limit of torque or of its rate binds, the force is shortened as a whole, so that
    it keeps its direction and the orientation stays held.
    """

    def __init__(
        self,
        limits: JointLimits,
        drives: JointDrives,
        mass: float = APPARENT_MASS,
        filter_time: float = FILTER_TIME,
    ) -> None:
        """``mass`` kg is what the hand feels like, ``filter_time`` s how late it feels a load.

        Raises `InvalidInputError` where one is not above zero.
        """
        for name, value in (("mass", mass), ("filter_time", filter_time)):
            if not (math.isfinite(value) and value > 0.0):
                raise InvalidInputError(f"{name} must be a positive number, found {value}")
        self._mass = mass
        self._limit = limits.torque
        self._torque_rate = limits.torque_rate
        self._damping = drives.damping
        self._drive_inertia = np.diag(drives.inertia)
        self._outer = OuterTorque(drives.friction, filter_time)
        self._home = np.zeros(JOINTS)
        self._orientation = (0.0, 0.0, 0.0, 1.0)
        self._last = HandCommand(np.zeros(JOINTS), np.zeros(3))
        self._time = -math.inf

    @property
    def load(self) -> np.ndarray:
        """[7] N m: what acts on the joints from outside, as estimated; friction is not in it."""
        return self._outer.load

    def hold(self, state: ArmState) -> None:
        """Takes the present orientation and posture as those to keep, and begins with no force."""
        self._home = state.joints.copy()
        x, y, z, w = state.orientation.tolist()
        self._orientation = (x, y, z, w)
        self._last = HandCommand(np.zeros(JOINTS), np.zeros(3))
        self._time = state.time
        self._outer.reset()

    def turn(self, state: ArmState) -> np.ndarray:
        """[3] rad: the rotation from the orientation to keep to the present one."""
        return rotation_between(self._orientation, state.orientation)

    def __call__(self, force: np.ndarray, state: ArmState) -> HandCommand:
        """Torques for a force [3] N on the hand. The last ones count as those that were sent."""
        J, velocity = state.jacobian, state.joint_velocity
        inertia = state.mass + self._drive_inertia
        bias = state.coriolis + self._damping * velocity
        self._outer.observe(state, inertia, bias)

        solved = np.linalg.solve(inertia, J.T)
        compliance = J @ solved
        shaped = np.linalg.inv(compliance)
        held = ROTATION_STIFFNESS * self.turn(state) + _RATE_SHARE * (J[3:] @ velocity)
        posture = _POSTURE_STIFFNESS * (self._home - state.joints)
        posture -= _POSTURE_DAMPING * velocity
        # The load's force on the hand is shaped @ solved.T @ load: only its first rows are felt.
        wanted = bias_acceleration(J, velocity)
        np.negative(wanted, out=wanted)
        wanted[:3] += (shaped[:3] @ (self._outer.load @ solved)) / self._mass
        light = compliance[3:, 3:]
        wanted[3:] -= light @ np.linalg.solve(_UNIT + _TURN_SHARE * light, held)
        spread = J.T @ shaped
        free = spread @ (wanted - posture @ solved) + posture + bias - self._outer.total
        push = spread[:, :3] @ (force / self._mass)
        self._last = self._within_limits(free, push, force, state.time)
        return self._last

    def _within_limits(
        self, free: np.ndarray, push: np.ndarray, force: np.ndarray, time: float
    ) -> HandCommand:
        """``free`` [7] N m plus as much of a ``force``'s ``push`` [7] N m as may be."""
        limit, last = self._limit, self._last
        free = np.minimum(np.maximum(free, -limit), limit)
        room = np.where(push > 0.0, limit - free, limit + free)
        pushed = np.abs(push)
        share = min(1.0, float((room / np.maximum(pushed, 1e-9)).min()))
        step = free + share * push - last.torque
        # Ticks that were missed still count for what the joints may change by.
        allowed = self._torque_rate * max(time - self._time, TICK)
        part = min(1.0, allowed / max(float(np.abs(step).max()), 1e-9))
        self._time = time
        return HandCommand(
            torque=last.torque + part * step,
            force=last.force + part * (share * force - last.force),
        )
