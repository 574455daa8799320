"""Scripted experts of the tasks in which geometry does not tell holding; they see it."""

import numpy as np

from contactgraph.data import Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.exploration import NoisyPolicy
from contactgraph.envs.gripper_task import GRIPPER, MAX_FORCE
from contactgraph.envs.pickup import carried_targets
from contactgraph.envs.pickup_layout import RADIUS

TOUCH_DISTANCE = 2.0 * RADIUS
"""Of the centres of two touching bodies, m."""
_STAND_OFF = 0.06
"""Gap behind a body from which it is approached, m."""

_GAIN = 4.0
"""1/s: the rate at which the velocity converges to the wanted one."""
_TOP_SPEED = 0.5
"""Of carrying, m/s."""
_PUSH_SPEED = 0.25
"""Of pushing a body that is not held, m/s: nothing but the gripper on its other side brakes it."""
_TOUCH_SPEED = 0.25
"""Of the gripper relative to a body at touch, m/s."""
_ROUND = 0.6
"""Missing speed of a body, m/s, for which the gripper goes round it to push from the right side."""
_PRESS = 0.5
"""Force that keeps a body touching, N."""
_BACK_OFF = 1.5
"""Force that parts the gripper from a body, N."""


def approach_velocity(
    offset: np.ndarray, direction: np.ndarray, speed: float, touch_speed: float
) -> np.ndarray:
    """The gripper's velocity relative to a body that it is to strike in ``direction``, [2] m/s.

    ``offset`` ``[2]`` m is the gripper's from the body, ``direction`` ``[2]`` has length 1. From
    behind the body the gripper strikes it at ``touch_speed`` m/s; from elsewhere it goes round the
    body at ``speed`` m/s.
    """
    behind = -float(offset @ direction)
    across = offset + behind * direction
    if behind > 0.8 * TOUCH_DISTANCE and np.linalg.norm(across) < 0.4 * TOUCH_DISTANCE:
        left = max(behind - TOUCH_DISTANCE - _STAND_OFF, 0.0)
        return min(touch_speed + 2.0 * left, speed) * direction - 4.0 * across
    goal = -(TOUCH_DISTANCE + _STAND_OFF) * direction
    if behind < TOUCH_DISTANCE:  # past its side first
        left_hand = np.array([-direction[1], direction[0]])
        side = left_hand if left_hand @ offset >= 0.0 else -left_hand
        goal = goal + 1.5 * TOUCH_DISTANCE * side
        if side @ offset < 1.2 * TOUCH_DISTANCE and behind > -2.0 * TOUCH_DISTANCE:
            goal = offset + TOUCH_DISTANCE * side
    return limited(4.0 * (goal - offset), speed)


def unit(vector: np.ndarray) -> np.ndarray:
    """``vector`` at length 1; the first axis for a vector of length 0."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0.0 else np.eye(len(vector))[0]


def limited(vector: np.ndarray, most: float) -> np.ndarray:
    """``vector``, shortened to the length ``most``."""
    length = float(np.linalg.norm(vector))
    return vector if length <= most else vector * (most / length)


class GripperForces:
    """Forces on a gripper that handles one body, in the state of an observation.

    The observation has the key ``holding``.
    """

    def __init__(self, observation: Observation, body: int) -> None:
        position, velocity = observation["position"], observation["velocity"]
        self.touches = bool(observation["contact"][GRIPPER, body])
        self.holds = bool(observation["holding"][GRIPPER, body])
        self.body_velocity = velocity[body]
        self.to_goal = observation["goal"] - position[body]
        """[2] m, from the body."""
        self.wanted = limited(2.0 * self.to_goal, _TOP_SPEED if self.holds else _PUSH_SPEED)
        """[2] m/s, of the body."""
        self.normal = unit(position[body] - position[GRIPPER])
        self._mass = 1 + int(observation["contact"][GRIPPER].sum())
        self._own = velocity[GRIPPER]
        self._from_body = position[GRIPPER] - position[body]

    def approach(
        self, least_missing: float = _ROUND, touch_speed: float = _TOUCH_SPEED
    ) -> np.ndarray:
        """[2] N to the body, and against it.

        Where the body misses more than ``least_missing`` m/s of the wanted velocity, the gripper
        goes to the side of the body from which a push helps.
        """
        missing = self.wanted - self.body_velocity
        direction = unit(missing) if np.linalg.norm(missing) > least_missing else self.normal
        velocity = approach_velocity(self._from_body, direction, 1.0, touch_speed)
        return 2.0 * self.move(self.body_velocity + velocity)

    def carry(self) -> np.ndarray:
        """[2] N that brings body and gripper to the goal."""
        return self.move(self.wanted)

    def press(self) -> np.ndarray:
        """[2] N along the normal, as far as that helps, and never less than keeps the touch."""
        across = self._own - self.body_velocity
        across = across - self.normal * (self.normal @ across)
        along = float(self.carry() @ self.normal)
        return max(along, _PRESS) * self.normal - _GAIN * across

    def accompany(self) -> np.ndarray:
        """[2] N that keeps the touch and hardly pushes."""
        return self.move(self.body_velocity + 0.02 * self.normal)

    def back_off(self) -> np.ndarray:
        """[2] N away from the body."""
        return -_BACK_OFF * self.normal

    def tear(self) -> np.ndarray:
        """[2] N away from the body that end its hold."""
        return -MAX_FORCE * self.normal

    def stop(self) -> np.ndarray:
        """[2] N that brings the gripper to rest."""
        return self.move(np.zeros(2))

    def move(self, velocity: np.ndarray) -> np.ndarray:
        """[2] N that bring the gripper to a velocity ``[2]`` m/s."""
        return limited(self._mass * _GAIN * (velocity - self._own), 3.0 * self._mass)


_CALM = 0.15
"""Distance from the goal within which the noise on the force fades, m."""
_TEAR_SPEED = 0.025
"""Speed, m/s, that a torn-off body loses: half the force, for one substep."""


class _Expert(NoisyPolicy):
    """What the experts share: a target, a random stream, and noise that fades at the goal."""

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where nothing is to be carried."""
        self._targets, self._dt = carried_targets(scene), scene.dt
        self._rng = np.random.default_rng(seed)
        super().reset(scene, int(self._rng.integers(2**31)))
        self._begin()

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N."""
        hand = GripperForces(observation, self._targets[0])
        force = self._act(hand)
        share = min(float(np.linalg.norm(hand.to_goal)) / _CALM, 1.0) ** 2
        if hand.touches and not hand.holds:  # else it would end the touch
            share *= 0.5
        return force + share * self._noise()

    def _begin(self) -> None:
        """Begins an episode."""

    def _act(self, hand: GripperForces) -> np.ndarray:
        """[2] N, without noise, that handle the first of the targets."""
        raise NotImplementedError

    def _shuffle(self) -> None:
        """Draws the order of the targets."""
        self._targets = [int(node) for node in self._rng.permutation(sorted(self._targets))]


class CarryExpert(_Expert):
    """Carries the target to the goal with a grip that begins and ends by itself.

    It presses a target that it touches but does not hold. Where that does not help, it notices
    after 0.2 s to its `patience`, backs off, and touches again. At the goal it rests.
    """

    patience = 0.8
    """The longest press that does not help, s."""

    def _begin(self) -> None:
        self._pressing, self._backing = self._rng.uniform(0.2, self.patience), 0.0

    def _act(self, hand: GripperForces) -> np.ndarray:
        if hand.holds:
            self._pressing = self._rng.uniform(0.2, self.patience)
            return hand.carry()
        if self._backing > 0.0:
            self._backing -= self._dt
            return hand.back_off()
        if np.linalg.norm(hand.body_velocity) < 0.02 and np.linalg.norm(hand.to_goal) < 0.05:
            return hand.stop()
        if not hand.touches:
            return hand.approach()
        if hand.normal @ (hand.wanted - hand.body_velocity) <= 0.0:  # a push does not help
            self._pressing -= self._dt
            if self._pressing <= 0.0:
                self._backing = self._rng.uniform(0.1, 0.15)
                self._pressing = self._rng.uniform(0.2, self.patience)
            return hand.accompany()
        return hand.press()


_PLACED = 0.005
"""Distance from the goal at which the target is put down, m."""
_STILL = 0.0015
"""Speed below which it is put down, m/s."""
_ASTRAY = 0.018
"""Distance from the goal at which a target that was put down is taken again, m."""
_ERRING = 0.3
"""Distance from the goal above which a noisy switch errs, m."""


class SuctionExpert(CarryExpert):
    """Takes the target by suction, carries it to the goal, and puts it down.

    It presses the target for 0.5 to 1.5 s before the switch goes on. At the goal, with the target
    at rest, it switches off, and backs away after 0.5 to 2 s. It takes a target again that does not
    stay there. Where the switch is hidden it is a `CarryExpert` that stays near the target.

    The noise fades at the goal. With noise on the force the switch errs, too: more than 0.3 m from
    the goal it goes off for 0.5 to 1.5 s, after 0.3 to 1.2 s, while the expert presses on.
    """

    patience = 60.0
    """No hold comes back by touching again: it stays near until a hidden switch is on."""

    def __init__(self, noise: float = 0.5) -> None:
        super().__init__(noise)
        self._errs = noise > 0.0

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where nothing is to be carried."""
        self._has_switch = "switch" in (scene.control_kind or ())
        super().reset(scene, seed)

    def _begin(self) -> None:
        if not self._has_switch:
            super()._begin()
            return
        self._on, self._left, self._placed = False, self._rng.uniform(0.5, 1.5), False

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[3]``: force, N, and switch; ``[2]`` N where the switch is hidden."""
        force = super().__call__(observation)
        return np.append(force, float(self._on)) if self._has_switch else force

    def _act(self, hand: GripperForces) -> np.ndarray:
        if not self._has_switch:
            return super()._act(hand)
        away = float(np.linalg.norm(hand.to_goal))
        if self._placed and away > _ASTRAY:
            self._placed, self._left = False, 0.0
        if hand.holds and away < _PLACED and np.linalg.norm(hand.body_velocity) < _STILL:
            self._placed, self._on, self._left = True, False, self._rng.uniform(0.5, 2.0)
        if hand.touches:
            self._left -= self._dt
        if hand.touches and not self._placed and self._left <= 0.0:
            self._on = not (self._on and self._errs and away > _ERRING)
            self._left = self._rng.uniform(0.3, 1.2) if self._on else self._rng.uniform(0.5, 1.5)
        if self._placed:
            leaves = hand.touches and not hand.holds and self._left <= 0.0
            return hand.back_off() if leaves else hand.stop()
        if not hand.touches:
            return hand.approach()
        return hand.carry() if self._on else hand.press()


_GENTLE = 3.0
"""Force of a pull that ends no hold, N."""
_MOVES = 0.02
"""Speed above which a body is not welded, m/s."""
_NEAR = 0.1
"""Distance from the goal within which a body may rest, m."""


class LookAlikesExpert(_Expert):
    """Takes hold of the targets in random order, and carries the one that moves to the goal.

    It pulls gently for 0.3 to 0.6 s, tears itself off a body that has not moved by then, and goes
    to the next. It knows no more than what is observed.
    """

    def _begin(self) -> None:
        self._shuffle()
        self._pulling = self._rng.uniform(0.3, 0.6)

    def _act(self, hand: GripperForces) -> np.ndarray:
        if self._pulling <= 0.0:
            if hand.holds:
                return hand.tear()
            self._targets.append(self._targets.pop(0))
            self._pulling = self._rng.uniform(0.3, 0.6)
            return hand.back_off()
        if not hand.holds:
            return hand.approach()
        if np.linalg.norm(hand.body_velocity) > _MOVES:
            return hand.carry()
        self._pulling -= self._dt * (np.linalg.norm(hand.to_goal) > _NEAR)
        return limited(hand.carry(), _GENTLE)


_TRIAL_SPEED = 0.15
"""Of a body that is tried, m/s."""


class StickyExpert(_Expert):
    """Tries the targets in random order until one holds, and carries that one to the goal.

    It tries a target by pressing it for 1.4 to 2.6 s, or 0.3 s where it holds, and pulling back. At
    the goal it tears itself off.
    """

    def __init__(self, noise: float = 0.3) -> None:
        super().__init__(noise)

    def _begin(self) -> None:
        self._shuffle()
        self._left = len(self._targets)
        self._begin_trial()

    def _begin_trial(self) -> None:
        self._pressing, self._pulling = self._rng.uniform(1.4, 2.6), 0.2
        self._found = False

    def _act(self, hand: GripperForces) -> np.ndarray:
        if self._found:
            return self._bring(hand)
        if self._pressing > 0.0:
            if not hand.touches:
                return hand.approach(least_missing=0.1, touch_speed=_TRIAL_SPEED)
            # It feels a hold at once, and the lack of one only by pulling.
            self._pressing = min(self._pressing, 0.3) if hand.holds else self._pressing
            self._pressing -= self._dt
            slow = float(hand.body_velocity @ hand.normal) < _TRIAL_SPEED
            return hand.press() if slow else hand.accompany()
        if self._pulling > 0.0:
            self._pulling -= self._dt
            return hand.back_off()
        if hand.touches:
            self._found = True
            return hand.carry()
        self._targets.append(self._targets.pop(0))
        self._left -= 1
        if self._left > 0:
            self._begin_trial()
        else:
            self._begin()
        return hand.back_off()

    def _bring(self, hand: GripperForces) -> np.ndarray:
        away = float(np.linalg.norm(hand.to_goal))
        if not hand.holds:
            return hand.stop() if away < 0.07 else hand.approach()
        if away > 0.03:
            return hand.carry()
        error = hand.body_velocity - _TEAR_SPEED * hand.normal
        return hand.tear() if np.linalg.norm(error) < 0.01 else hand.move(_TEAR_SPEED * hand.normal)
