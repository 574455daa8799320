"""Impedance control of the hand: a mass with a fixed orientation, moved by forces."""

import math
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.driver.arm import CYCLE, JOINTS, ArmState, JointDrives, JointLimits

APPARENT_MASS = 4.0
"""kg, of the hand under a force: about the arm's own at the hand."""
FILTER_TIME = 0.004
"""s, of the external torque. An arm with noisy joint velocities may need more."""
ROTATION_STIFFNESS = 8.0
"""N m/rad"""
ROTATION_DAMPING = 2.0 * math.sqrt(ROTATION_STIFFNESS)
"""N m s/rad"""
_LOOKAHEAD = 0.005
"""s, of the rotation's damping. Without it, 6 N m s/rad on a hand of 0.002 kg m^2 about its own
axis would become unstable under two cycles of delay."""
_RATE_SHARE = ROTATION_DAMPING + _LOOKAHEAD * ROTATION_STIFFNESS
_TURN_SHARE = _LOOKAHEAD * _RATE_SHARE
_POSTURE_STIFFNESS = 10.0
_POSTURE_DAMPING = 4.0
_SLIDING = 0.02
"""rad/s: a joint well above it slides, one well below it sticks."""
_UNIT = np.eye(3)


def bias_acceleration(jacobian: np.ndarray, joint_velocity: np.ndarray) -> np.ndarray:
    r"""$\dot J \dot q$ ``[6]`` (m/s^2, rad/s^2): the hand's acceleration if no joint accelerates.

    ``jacobian`` [6, 7] of a serial arm of revolute joints, ``joint_velocity`` [7] rad/s. Exact, and
    from the Jacobian alone: with $v_j$ and $w_j$ joint j's share in the hand's velocity and angular
    velocity, and $W_j = w_1 + \dots + w_j$,

    $$ \dot J \dot q = \Big( \sum_j (2 W_j - w_j) \times v_j,\; \sum_j W_j \times w_j \Big), $$

    since the axis of a joint turns with all joints before it, and its moment arm with all after it.
    """
    shares = jacobian * joint_velocity
    linear, angular = shares[:3], shares[3:]
    total = np.cumsum(angular, axis=1)
    # A sum of cross products is the skew part of a product of matrices.
    F = (2.0 * total - angular) @ linear.T
    G = total @ angular.T
    return np.array(
        [
            F[1, 2] - F[2, 1],
            F[2, 0] - F[0, 2],
            F[0, 1] - F[1, 0],
            G[1, 2] - G[2, 1],
            G[2, 0] - G[0, 2],
            G[0, 1] - G[1, 0],
        ]
    )


def rotation_between(before: tuple[float, float, float, float], after: np.ndarray) -> np.ndarray:
    """[3] rad, in the frame of the base: the rotation from one orientation to another.

    Both are unit quaternions (x, y, z, w); ``before`` as plain numbers.
    """
    # Plain numbers: at 1 kHz, arrays of three and scipy's Rotation take longer than the arithmetic.
    a, b, c, d = before
    x, y, z, w = after.tolist()
    # after * conj(before)
    turn_w = w * d + x * a + y * b + z * c
    turn_x = -w * a + x * d - y * c + z * b
    turn_y = -w * b + x * c + y * d - z * a
    turn_z = -w * c - x * b + y * a + z * d
    sine = math.sqrt(turn_x * turn_x + turn_y * turn_y + turn_z * turn_z)
    if sine < 1e-9:
        return np.zeros(3)
    # The shorter rotation: a quaternion and its negative are one orientation.
    angle = 2.0 * math.atan2(sine, abs(turn_w))
    scale = math.copysign(angle / sine, turn_w)
    return np.array([scale * turn_x, scale * turn_y, scale * turn_z])


class ExternalTorqueObserver:
    r"""A momentum observer (De Luca and Mattone 2003) that separates dry friction from load.

    The torques $\tau_o$ besides the motors', computed from the last cycle's motion as

    $$ \tau_o = M \frac{\Delta \dot q}{\Delta t} + h - \tau, $$

    are low-passed. Dry friction is the part of them that friction can cause: $-f \tanh(\dot q / v)$
    in a joint that slides with velocity $\dot q$, up to $\pm f$ in one that sticks. The rest
    is load, which the hand yields to; known friction is compensated.
    """

    def __init__(self, friction: np.ndarray, filter_time: float) -> None:
        """``friction`` [7] N m, dry; ``filter_time`` s is the estimates' time constant."""
        self._friction = friction
        self._filter_time = filter_time
        self.reset()

    def reset(self) -> None:
        """Forgets all states."""
        self.total = np.zeros(JOINTS)
        """[7] N m: all torques besides the motors'."""
        self.load = np.zeros(JOINTS)
        """[7] N m: the part that friction cannot cause."""
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


@dataclass(slots=True)
class HandCommand:
    """Torques for the joints, and the force on the hand that they amount to."""

    torque: np.ndarray
    """[7] N m, without gravity compensation."""
    force: np.ndarray
    """[3] N: the part of the requested force that the limits permit."""


class HandImpedance:
    r"""Torques with which the hand moves as a mass of 4 kg under a force, orientation held.

    Impedance control with inertia shaping (Hogan 1985; Khatib 1987). With J the Jacobian of the
    grasp point, M the inertia of links and drives, $\Lambda = (J M^{-1} J^T)^{-1}$, h the Coriolis
    and damping torques, $\hat\tau$ the external joint torques (`ExternalTorqueObserver`),
    $\hat f$ the load on the hand in them, and $\tau_0$ a null-space torque that returns the elbow
    to its posture,

    $$ \tau = J^T \Lambda (a - \dot J \dot q) + h - \hat\tau + \tau_0, \qquad
       a = \big( (u + \hat f) / m,\; \text{stiffness and damping of the rotation} \big). $$

    The rotation's spring and damper are evaluated a few cycles ahead (as in an implicit Euler
    step), so that directions in which the hand is light are held no faster than the loop can
    follow. Where a limit of a joint's torque or torque rate binds, the force is shortened as a
    whole: it keeps its direction, and the orientation stays held.
    """

    def __init__(
        self,
        limits: JointLimits,
        drives: JointDrives,
        mass: float = APPARENT_MASS,
        filter_time: float = FILTER_TIME,
    ) -> None:
        """``mass`` kg is the apparent mass, ``filter_time`` s the delay of the load's estimate.

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
        self._external = ExternalTorqueObserver(drives.friction, filter_time)
        self._posture = np.zeros(JOINTS)
        self._orientation = (0.0, 0.0, 0.0, 1.0)
        self._last = HandCommand(np.zeros(JOINTS), np.zeros(3))
        self._time = -math.inf

    @property
    def load(self) -> np.ndarray:
        """[7] N m: the estimated external torque on the joints, without friction."""
        return self._external.load

    def hold(self, state: ArmState) -> None:
        """Takes the present orientation and posture as those to keep, and begins with no force."""
        self._posture = state.joints.copy()
        x, y, z, w = state.orientation.tolist()
        self._orientation = (x, y, z, w)
        self._last = HandCommand(np.zeros(JOINTS), np.zeros(3))
        self._time = state.time
        self._external.reset()

    def turn(self, state: ArmState) -> np.ndarray:
        """[3] rad: the rotation from the orientation to keep to the present one."""
        return rotation_between(self._orientation, state.orientation)

    def __call__(self, force: np.ndarray, state: ArmState) -> HandCommand:
        """Torques for a force [3] N on the hand. The last result counts as sent."""
        J, velocity = state.jacobian, state.joint_velocity
        inertia = state.mass + self._drive_inertia
        bias = state.coriolis + self._damping * velocity
        self._external.observe(state, inertia, bias)

        solved = np.linalg.solve(inertia, J.T)
        compliance = J @ solved
        shaped = np.linalg.inv(compliance)
        moment = ROTATION_STIFFNESS * self.turn(state) + _RATE_SHARE * (J[3:] @ velocity)
        posture = _POSTURE_STIFFNESS * (self._posture - state.joints)
        posture -= _POSTURE_DAMPING * velocity
        # The load's force on the hand is shaped @ solved.T @ load; only its first rows count.
        acceleration = bias_acceleration(J, velocity)
        np.negative(acceleration, out=acceleration)
        acceleration[:3] += (shaped[:3] @ (self._external.load @ solved)) / self._mass
        light = compliance[3:, 3:]
        acceleration[3:] -= light @ np.linalg.solve(_UNIT + _TURN_SHARE * light, moment)
        spread = J.T @ shaped
        free = spread @ (acceleration - posture @ solved) + posture + bias - self._external.total
        push = spread[:, :3] @ (force / self._mass)
        self._last = self._within_limits(free, push, force, state.time)
        return self._last

    def _within_limits(
        self, free: np.ndarray, push: np.ndarray, force: np.ndarray, time: float
    ) -> HandCommand:
        """``free`` [7] N m plus as much of a ``force``'s ``push`` [7] N m as the limits permit."""
        limit, last = self._limit, self._last
        free = np.minimum(np.maximum(free, -limit), limit)
        margin = np.where(push > 0.0, limit - free, limit + free)
        share = min(1.0, float((margin / np.maximum(np.abs(push), 1e-9)).min()))
        step = free + share * push - last.torque
        # Missed cycles count for the permitted change.
        allowed = self._torque_rate * max(time - self._time, CYCLE)
        part = min(1.0, allowed / max(float(np.abs(step).max()), 1e-9))
        self._time = time
        return HandCommand(
            torque=last.torque + part * step,
            force=last.force + part * (share * force - last.force),
        )
