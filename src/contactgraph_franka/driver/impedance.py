"""Kinematics of the hand that need no more than its Jacobian and its orientation."""

import math
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.driver.arm import JOINTS, TICK, ArmState, JointDrives, JointLimits


def bias_acceleration(jacobian: np.ndarray, joint_velocity: np.ndarray) -> np.ndarray:
    r"""$\dot J \dot q$ ``[6]`` (m/s^2, rad/s^2): how the hand accelerates if no joint does.

    ``jacobian`` [6, 7] of a serial arm of revolute joints, ``joint_velocity`` [7] rad/s. Exact, and
    from the Jacobian alone: with $v_j$ and $w_j$ joint j's share in the hand's velocity and angular
    velocity, and $W_j = w_1 + \dots + w_j$,

    $$ \dot J \dot q = \Big( \sum_j (2 W_j - w_j) \times v_j,\; \sum_j W_j \times w_j \Big), $$

    since the axis of a joint turns with all joints before it, and its lever with all after it.
    """
    shares = jacobian * joint_velocity
    linear, angular = shares[:3], shares[3:]
    turned = np.cumsum(angular, axis=1)
    # A sum of cross products is the skew part of a product of matrices.
    F = (2.0 * turned - angular) @ linear.T
    G = turned @ angular.T
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
    # Plain numbers: at a kilohertz, arrays of three take longer than what they are asked.
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
    # The shorter way round: a quaternion and its negative are one orientation.
    angle = 2.0 * math.atan2(sine, abs(turn_w))
    scale = math.copysign(angle / sine, turn_w)
    return np.array([scale * turn_x, scale * turn_y, scale * turn_z])


_SLIDING = 0.02
"""rad/s: well above it a joint slides, well below it sticks."""


class ExternalTorqueObserver:
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
    and damping torques, $\hat\tau$ what else acts on the joints (`ExternalTorqueObserver`),
    $\hat f$ the
    load on the hand in it, and $\tau_0$ what draws the elbow home without moving the hand,

    $$ \tau = J^T \Lambda (a - \dot J \dot q) + h - \hat\tau + \tau_0, \qquad
       a = \big( (u + \hat f) / m,\; \text{stiffness and damping of the rotation} \big). $$

    The rotation's spring and damper are those a few ticks ahead (as in an implicit Euler step), so
    that directions in which the hand is light are held no faster than the loop can follow.

    Where a joint's limit of torque or of its rate binds, the force is clip_norm as a whole, so that
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
        self._outer = ExternalTorqueObserver(drives.friction, filter_time)
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
