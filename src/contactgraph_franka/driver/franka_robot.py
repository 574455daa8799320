"""An arm of Franka's as a `Robot`, over the maker's protocol."""

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
    check_transfer,
    connect,
    first_state,
    franky,
    transfer,
)
from contactgraph_franka.driver.description import describe_arm, describe_limits
from contactgraph_franka.driver.impedance import HandImpedance
from contactgraph_franka.driver.readings import Fingers, ObjectSource, ReadingBuilder
from contactgraph_franka.safety.limits import SafetyLimits
from contactgraph_franka.safety.robot import RobotReading, Stop, StopReason

GRASP_POINT = (0.0, 0.0, 0.1254)
"""m, from the flange: between the fingers where they hold a block, 22 mm beyond the middle of the
pads of the maker's hand, so that a block 0.1 m high clears the palm."""
SILENCE = 0.02
"""s without a torque after which the arm's end of the loop stops the arm."""
COLLISION_TORQUE = 20.0
"""N m, in each joint: the arm's own reflex stops it beyond."""
COLLISION_FORCE = 30.0
"""N, and N m about each axis, on the hand: likewise."""
_STOP_DAMPING = np.array([40.0, 40.0, 40.0, 40.0, 6.0, 6.0, 0.5])
"""N m s/rad, of the arm's brake: as firm as torques that change by 1 N m a tick allow. Firmer ones
throw the hand back."""
_STOP_RAMP = 0.005
"""s, in which the brake takes over from the last torques."""
_LONGEST_BRAKE = 5.0
"""Wall seconds that a motion is given to end."""
_UNFILTERED = 1000.0
"""Hz. The client's low-pass, 100 Hz if nobody says otherwise, would lag by two ticks."""


class FrankaRobot:
    """The hand (node 0) of an arm, moved by forces, and the objects that ``objects`` tells of.

    A `Robot`: `resume` takes control, `send` turns forces into torques (`HandImpedance`), `stop`
    brakes. Whatever ends the arm's motion (a reflex, its stop button, a lost connection, silence)
    is `ended`, never an exception. Use as a context manager. One thread reads and sends.
    """

    def __init__(
        self,
        address: str,
        objects: ObjectSource | None = None,
        clock: Callable[[], float] = time.monotonic,
        limits: JointLimits = FR3_LIMITS,
        drives: JointDrives = NO_DRIVES,
        fingers: Fingers | None = None,
    ) -> None:
        """Connects to ``address``; nothing moves.

        ``fingers`` act while forces do, and are the contact sensor; None: they are left alone.
        ``clock`` gives s, on which all is stamped. ``drives`` say what the joints' friction and
        rotors are, where that is known: friction that is not there would push the hand on.
        Raises `InvalidInputError` where no arm answers, or one of another generation.
        """
        self.address = address
        self.limits = limits
        self.ended: Stop | None = None
        """Why and when the arm ended its motion by itself; None while it has not."""
        self.last_error = ""
        """What the arm's client said about that."""
        self._nodes = ReadingBuilder(objects, fingers)
        self._clock = clock
        self._arm = connect(address)
        self._model = self._arm.model
        self._law = HandImpedance(limits, drives)
        self._arm_clock = ClockOffset()
        self._motion: franky.SimpleTorqueMotion | None = None
        self._running = False
        """Whether a motion of ours was begun whose end has not been noted."""
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
        """Whether torques of ours move the arm now."""
        return self._motion is not None and self._arm.is_in_control

    def read(self) -> RobotReading | None:
        """Hand and objects as the newest state of the arm tells; None where there is no newer.

        Immediate while torques run; else it waits for a state, a tick.
        """
        if self._running and not self._arm.is_in_control:
            self._note_end()
        if self._lost:
            return None
        try:
            told = self._arm.state
        except CLIENT_FAULTS as error:
            self._end(StopReason.CONNECTION_LOST, error)
            return None
        now = self._clock()
        milliseconds = told.time.to_msec()
        if milliseconds == self._milliseconds:
            self._arm_clock.unchanged(now)
            return None
        self._milliseconds = milliseconds
        self._state = state = self._arm_state(told)
        stamp = self._arm_clock.changed(state.time, now)
        hand = self._model.pose(
            franky.Frame.EndEffector, state.joints, self._grasp_frame, self._stiffness_frame
        )
        speed = state.jacobian[:3] @ state.joint_velocity
        return self._nodes.reading(
            hand.translation, speed, stamp, state.time, now, acting=self._motion is not None
        )

    def send(self, force: np.ndarray, now: float) -> np.ndarray | None:
        """Torques for a ``force`` [3] N, from the last state that was read.

        Returns as much of the force as joint limits left; None where no motion of ours runs.
        """
        motion, state = self._motion, self._state
        if motion is None or state is None:
            return None
        if not self._arm.is_in_control:
            self._note_end()
            return None
        told = self._law(force, state)
        if not math.isfinite(told.torque.sum()):
            return None
        motion.set_torque(told.torque)
        return told.force

    def stop(self, stop: Stop) -> None:
        """Brakes each joint until it rests; then the arm holds itself."""
        if self._motion is None:
            return
        self._motion = None
        if self._arm.is_in_control:
            self._begin(franky.TorqueStopMotion(damping=_STOP_DAMPING, ramp_duration=_STOP_RAMP))

    def resume(self) -> None:
        """Takes control: the hand keeps its present orientation, and floats.

        Where torques run already, nothing changes.
        """
        if self.moving:
            return
        self._note_end()
        self.ended = None
        try:
            self._milliseconds = -1
            self._state = state = self._arm_state(self._arm.state)
        except CLIENT_FAULTS as error:
            self._end(StopReason.CONNECTION_LOST, error)
            return
        self._law.hold(state)
        motion = franky.SimpleTorqueMotion(
            signal_timeout=SILENCE,
            lower_joint_limits=self.limits.low,
            upper_joint_limits=self.limits.high,
        )
        if self._begin(motion):
            self._motion = motion

    def recover(self) -> bool:
        """After a reflex, or whatever `ended` the motion: whether the arm can move again."""
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

        ``speed`` is the share of the arm's own limits. Returns when it is there: None, or why the
        arm stopped on the way. Raises `InvalidInputError` for arguments that are none.
        """
        check_transfer(position, yaw, speed)
        if self.moving:
            raise InvalidInputError("the arm is under control of forces: stop it before move_to")
        self._note_end(patience=_LONGEST_BRAKE)
        self.ended = None
        try:
            transfer(self._arm, position, yaw, speed, self._beyond_hand, self._clock)
        except CLIENT_FAULTS as error:
            self._end(_reason(error), error)
        return self.ended

    def hand_pose(self) -> np.ndarray:
        """[4, 4]: the hand's frame in that of the base, now; also while a person guides it.

        Raises `InvalidInputError` where the arm does not answer any more.
        """
        try:
            return np.asarray(self._arm.state.O_T_EE.matrix)
        except CLIENT_FAULTS as error:
            raise InvalidInputError(f"the arm at {self.address} is lost: {error}") from error

    def describe(self, limits: SafetyLimits) -> list[tuple[str, str]]:
        """Versions, state and limits as names and words. Raises nothing of the arm's."""
        reflex = (COLLISION_TORQUE, COLLISION_FORCE)
        told = describe_limits(limits, self.limits, reflex)
        try:
            return [("address", self.address), *describe_arm(self._arm.state, self.limits), *told]
        except CLIENT_FAULTS as error:
            self._end(StopReason.CONNECTION_LOST, error)
            return [("address", self.address), ("connection", f"lost: {error}"), *told]

    def close(self) -> None:
        """Brakes where the arm moves, and lets go of it."""
        self.stop(Stop(StopReason.FINISHED, self._clock()))
        self._note_end(patience=_LONGEST_BRAKE)

    @property
    def _lost(self) -> bool:
        return self.ended is not None and self.ended.reason is StopReason.CONNECTION_LOST

    def _arm_state(self, told: "franky.RobotState") -> ArmState:
        model, joints = self._model, told.q
        return ArmState(
            time=1e-3 * told.time.to_msec(),
            joints=joints,
            joint_velocity=told.dq,
            torque=told.tau_J_d,
            mass=model.mass(told),
            coriolis=model.coriolis(told),
            jacobian=model.zero_jacobian(
                franky.Frame.EndEffector, joints, self._grasp_frame, self._stiffness_frame
            ),
            orientation=told.O_T_EE.quaternion,
        )

    def _begin(self, motion: "franky.SimpleTorqueMotion | franky.TorqueStopMotion") -> bool:
        try:
            self._arm.move(motion, asynchronous=True, cutoff_frequency=_UNFILTERED)
        except CLIENT_FAULTS as error:
            self._end(_reason(error), error)
            return False
        self._running = True
        return True

    def _note_end(self, patience: float = 0.0) -> None:
        """Takes in why the last motion ended, if by itself; waits ``patience`` s for that."""
        self._motion = None
        self._running = False
        try:
            self._arm.join_motion(patience)
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
