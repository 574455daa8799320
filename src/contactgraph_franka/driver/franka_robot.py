"""Driver of a Franka arm: a `Robot` over the maker's protocol."""

import math
import time
from collections.abc import Callable

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.driver.arm import (
    FR3_LIMITS,
    NO_DRIVES,
    ArmState,
    ClockOffset,
    JointDrives,
    JointLimits,
)
from contactgraph_franka.driver.client import (
    CLIENT_FAULTS,
    PLANNER_FAULT,
    check_target,
    connect,
    first_state,
    franky,
    move_to_pose,
)
from contactgraph_franka.driver.description import describe_arm, describe_limits
from contactgraph_franka.driver.gripper import FrankaGripper
from contactgraph_franka.driver.impedance import HandImpedance
from contactgraph_franka.driver.readings import ObjectSource, ReadingBuilder
from contactgraph_franka.safety.limits import SafetyLimits
from contactgraph_franka.safety.robot import RobotReading, Stop, StopReason

GRASP_POINT = (0.0, 0.0, 0.1254)
"""m, from the flange: the grasp point between the fingers, 22 mm beyond the middle of the pads of
the maker's hand, so that a block 0.1 m high clears the palm."""
SILENCE = 0.02
"""s without a torque after which the client's control thread stops the arm."""
COLLISION_TORQUE = 20.0
"""N m, in each joint: a larger external torque triggers the arm's own reflex stop."""
COLLISION_FORCE = 30.0
"""N, and N m about each axis, on the hand: the same."""
_STOP_DAMPING = np.array([40.0, 40.0, 40.0, 40.0, 6.0, 6.0, 0.5])
"""N m s/rad, of the arm's brake: as firm as torques that change by 1 N m a cycle permit. A firmer
brake throws the hand back."""
_STOP_RAMP = 0.005
"""s, of the transition from the last torques to the brake."""
_LONGEST_BRAKE = 5.0
"""Wall seconds to wait for the end of a motion."""
_UNFILTERED = 1000.0
"""Hz. The client's default low-pass of 100 Hz would lag by two cycles."""


class FrankaRobot:
    """The hand (node 0) of an arm, moved by forces, and the objects of an `ObjectSource`.

    A `Robot`: `resume` takes control, `send` turns forces into torques (`HandImpedance`), `stop`
    brakes. Every end of the arm's motion (a reflex, its stop button, a lost connection, silence)
    is reported by `ended`, never by an exception. Use as a context manager. One thread reads and
    sends.
    """

    def __init__(
        self,
        address: str,
        objects: ObjectSource | None = None,
        clock: Callable[[], float] = time.monotonic,
        limits: JointLimits = FR3_LIMITS,
        drives: JointDrives = NO_DRIVES,
        fingers: FrankaGripper | None = None,
    ) -> None:
        """Connects to ``address``; nothing moves.

        ``fingers`` move only while forces act, and are the contact sensor; None: they do not move.
        ``clock`` gives s, for all time stamps. ``drives`` are the joints' friction and rotors,
        where they are known: compensating absent friction would accelerate the hand.
        Raises `InvalidInputError` where no arm answers, or one of another generation.
        """
        self.address = address
        self.limits = limits
        self.ended: Stop | None = None
        """Why and when the arm ended its motion by itself; None while it has not."""
        self.last_error = ""
        """The message of the arm's client about it."""
        self._readings = ReadingBuilder(objects, fingers)
        self._clock = clock
        self._arm = connect(address)
        self._model = self._arm.model
        self._impedance = HandImpedance(limits, drives)
        self._clock_offset = ClockOffset()
        self._motion: franky.SimpleTorqueMotion | None = None
        self._running = False
        """Whether a motion was begun whose end has not been handled."""
        self._state: ArmState | None = None
        self._milliseconds = -1
        first = first_state(self._arm, address)
        flange_to_hand = first.F_T_EE
        self._grasp_frame = franky.Affine(np.array(GRASP_POINT), flange_to_hand.quaternion)
        self._beyond_hand = flange_to_hand.inverse * self._grasp_frame
        self._stiffness_frame = first.EE_T_K
        self._arm.set_collision_behavior(COLLISION_TORQUE, COLLISION_FORCE)

    def __enter__(self) -> "FrankaRobot":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def moving(self) -> bool:
        """Whether torques of this program move the arm now."""
        return self._motion is not None and self._arm.is_in_control

    def read(self) -> RobotReading | None:
        """Hand and objects at the newest state of the arm; None where there is no newer one.

        It returns at once while torques run, else after a cycle, with the next state.
        """
        if self._running and not self._arm.is_in_control:
            self._handle_end()
        if self._lost:
            return None
        try:
            raw = self._arm.state
        except CLIENT_FAULTS as error:
            self._end(StopReason.CONNECTION_LOST, error)
            return None
        now = self._clock()
        milliseconds = raw.time.to_msec()
        if milliseconds == self._milliseconds:
            self._clock_offset.unchanged(now)
            return None
        self._milliseconds = milliseconds
        self._state = state = self._arm_state(raw)
        stamp = self._clock_offset.changed(state.time, now)
        hand = self._model.pose(
            franky.Frame.EndEffector, state.joints, self._grasp_frame, self._stiffness_frame
        )
        speed = state.jacobian[:3] @ state.joint_velocity
        return self._readings.reading(
            hand.translation, speed, stamp, state.time, now, acting=self._motion is not None
        )

    def send(self, force: np.ndarray, now: float) -> np.ndarray | None:
        """Sends torques for a ``force`` [3] N at the last state read.

        Returns the part of the force that joint limits permit; None where no torques run.
        """
        motion, state = self._motion, self._state
        if motion is None or state is None:
            return None
        if not self._arm.is_in_control:
            self._handle_end()
            return None
        command = self._impedance(force, state)
        if not math.isfinite(command.torque.sum()):
            return None
        motion.set_torque(command.torque)
        return command.force

    def stop(self, stop: Stop) -> None:
        """Brakes each joint to rest; then the arm holds its position."""
        if self._motion is None:
            return
        self._motion = None
        if self._arm.is_in_control:
            self._begin(franky.TorqueStopMotion(damping=_STOP_DAMPING, ramp_duration=_STOP_RAMP))

    def resume(self) -> None:
        """Takes control: the hand keeps its present orientation, and moves freely.

        Where torques run already, nothing changes.
        """
        if self.moving:
            return
        self._handle_end()
        self.ended = None
        try:
            self._milliseconds = -1
            self._state = state = self._arm_state(self._arm.state)
        except CLIENT_FAULTS as error:
            self._end(StopReason.CONNECTION_LOST, error)
            return
        self._impedance.hold(state)
        motion = franky.SimpleTorqueMotion(
            signal_timeout=SILENCE,
            lower_joint_limits=self.limits.low,
            upper_joint_limits=self.limits.high,
        )
        if self._begin(motion):
            self._motion = motion

    def recover(self) -> bool:
        """Recovers from a reflex or another end of the motion; whether the arm can move again."""
        self._motion = None
        try:
            recovered = self._arm.recover_from_errors()
        except CLIENT_FAULTS as error:
            self._end(StopReason.CONNECTION_LOST, error)
            return False
        if recovered:
            self.ended = None
        return recovered

    def move_to(self, position: np.ndarray, yaw: float = 0.0, speed: float = 0.1) -> Stop | None:
        """Moves the grasp point to ``position`` [3] m, pointing down, turned by ``yaw`` rad.

        ``speed`` is the share of the arm's own limits. Returns None at the target, or the reason
        why the arm stopped before it. Raises `InvalidInputError` for invalid arguments.
        """
        check_target(position, yaw, speed)
        if self.moving:
            raise InvalidInputError("the arm is under control of forces: stop it before move_to")
        self._handle_end(timeout=_LONGEST_BRAKE)
        self.ended = None
        try:
            move_to_pose(self._arm, position, yaw, speed, self._beyond_hand, self._clock)
        except CLIENT_FAULTS as error:
            self._end(_reason(error), error)
        return self.ended

    def hand_pose(self) -> np.ndarray:
        """[4, 4]: the hand's present frame in that of the base; also while a person guides it.

        Raises `InvalidInputError` where the arm no longer answers.
        """
        try:
            return np.asarray(self._arm.state.O_T_EE.matrix)
        except CLIENT_FAULTS as error:
            raise InvalidInputError(f"the arm at {self.address} is lost: {error}") from error

    def describe(self, limits: SafetyLimits) -> list[tuple[str, str]]:
        """Versions, state and limits as names and texts. Raises no error of the arm."""
        reflex = (COLLISION_TORQUE, COLLISION_FORCE)
        limit_lines = describe_limits(limits, self.limits, reflex)
        try:
            state_lines = describe_arm(self._arm.state, self.limits)
        except CLIENT_FAULTS as error:
            self._end(StopReason.CONNECTION_LOST, error)
            state_lines = [("connection", f"lost: {error}")]
        return [("address", self.address), *state_lines, *limit_lines]

    def close(self) -> None:
        """Brakes where the arm moves, and disconnects."""
        self.stop(Stop(StopReason.FINISHED, self._clock()))
        self._handle_end(timeout=_LONGEST_BRAKE)

    @property
    def _lost(self) -> bool:
        return self.ended is not None and self.ended.reason is StopReason.CONNECTION_LOST

    def _arm_state(self, raw: "franky.RobotState") -> ArmState:
        model, joints = self._model, raw.q
        return ArmState(
            time=1e-3 * raw.time.to_msec(),
            joints=joints,
            joint_velocity=raw.dq,
            torque=raw.tau_J_d,
            mass=model.mass(raw),
            coriolis=model.coriolis(raw),
            jacobian=model.zero_jacobian(
                franky.Frame.EndEffector, joints, self._grasp_frame, self._stiffness_frame
            ),
            orientation=raw.O_T_EE.quaternion,
        )

    def _begin(self, motion: "franky.SimpleTorqueMotion | franky.TorqueStopMotion") -> bool:
        try:
            self._arm.move(motion, asynchronous=True, cutoff_frequency=_UNFILTERED)
        except CLIENT_FAULTS as error:
            self._end(_reason(error), error)
            return False
        self._running = True
        return True

    def _handle_end(self, timeout: float = 0.0) -> None:
        """Records why the last motion ended, if by itself; waits ``timeout`` s for that."""
        self._motion = None
        self._running = False
        try:
            self._arm.join_motion(timeout)
        except CLIENT_FAULTS as error:
            self._end(_reason(error), error)

    def _end(self, reason: StopReason, error: Exception) -> None:
        self.last_error = str(error)
        self.ended = Stop(reason, self._clock())


def _reason(error: Exception) -> StopReason:
    if isinstance(error, franky.TorqueSignalTimeoutException):
        return StopReason.COMMAND_LATE
    if isinstance(error, franky.ControlException | franky.CommandException):
        return StopReason.ARM_STOPPED
    if PLANNER_FAULT in str(error):
        return StopReason.ARM_STOPPED
    return StopReason.CONNECTION_LOST
