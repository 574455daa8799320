"""Scripted experts of the tasks in which geometry does not tell holding; they see it."""

import numpy as np

from contactgraph.data import Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.exploration import CorrelatedNoise
from contactgraph.envs.gripper_motion import GripperForces, limited
from contactgraph.envs.pickup import carried_targets

_CALM = 0.15
"""Distance from the goal within which the noise on the force fades, m."""


_TEAR_SPEED = 0.025
"""Speed, m/s, that a torn-off body loses: half the force, for one substep."""


class _Expert:
    """What the experts share: a target, a random stream, and noise that fades at the goal."""

    def __init__(self, noise: float = 0.5, correlation_steps: float = 2.0) -> None:
        self._noise = CorrelatedNoise(noise, correlation_steps)
        self._rng = np.random.default_rng(0)
        self._targets: list[int] = []
        self._dt = 0.0

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where nothing is to be carried."""
        self._targets, self._dt = carried_targets(scene), scene.dt
        self._rng = np.random.default_rng(seed)
        self._noise.reset(scene.dimension, int(self._rng.integers(2**31)))
        self._begin()

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N."""
        hand = GripperForces(observation, self._targets[0])
        return self._force(hand) + self._faded_noise(hand)

    def _begin(self) -> None:
        """Begins an episode."""

    def _force(self, hand: GripperForces) -> np.ndarray:
        """[2] N, without noise, that handle the first of the targets."""
        raise NotImplementedError

    def _faded_noise(self, hand: GripperForces) -> np.ndarray:
        """The next value, [2] N."""
        share = min(float(np.linalg.norm(hand.to_goal)) / _CALM, 1.0) ** 2
        if hand.touches and not hand.holds:  # else it would end the touch
            share *= 0.5
        return share * self._noise()

    def _time(self, shortest: float, longest: float) -> float:
        """A random time, s."""
        return float(self._rng.uniform(shortest, longest))

    def _shuffle(self) -> None:
        """Draws the order of the targets."""
        self._targets = [int(node) for node in self._rng.permutation(sorted(self._targets))]


_PLACED = 0.005
"""Distance from the goal at which the target is put down, m."""
_STILL = 0.0015
"""Speed below which it is put down, m/s."""
_ASTRAY = 0.018
"""Distance from the goal at which a target that was put down is taken again, m."""
_ERRING = 0.3
"""Distance from the goal above which a noisy switch errs, m."""


class SuctionExpert(_Expert):
    """Takes the target by suction, carries it to the goal, and puts it down.

    It presses the target for 0.5 to 1.5 s before the switch goes on. At the goal, with the target
    at rest, it switches off, and backs away after 0.5 to 2 s. It takes a target again that does not
    stay there. Where the switch is hidden it is a `CarryExpert` that stays near the target.

    ``noise`` N is the standard deviation of a force added on each axis, correlated over
    ``correlation_steps`` steps, which fades at the goal. With noise on the force the switch errs,
    too: more than 0.3 m from the goal it goes off for 0.5 to 1.5 s, after 0.3 to 1.2 s, while the
    expert presses on.
    """

    def __init__(self, noise: float = 0.5, correlation_steps: float = 2.0) -> None:
        super().__init__(noise, correlation_steps)
        self._errs = noise > 0.0
        self._on, self._left, self._placed = False, 0.0, False
        # No hold comes back by touching again: it stays near until the hidden switch is on.
        self._without_switch = CarryExpert(noise, correlation_steps, patience=60.0)
        self._has_switch = True

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where nothing is to be carried."""
        super().reset(scene, seed)
        self._without_switch.reset(scene, seed)
        self._has_switch = "switch" in (scene.control_kind or ())
        self._on, self._left, self._placed = False, self._time(0.5, 1.5), False

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[3]``: force, N, and switch; ``[2]`` N where the switch is hidden."""
        if not self._has_switch:
            return self._without_switch(observation)
        force = super().__call__(observation)
        return np.append(force, float(self._on))

    def _force(self, hand: GripperForces) -> np.ndarray:
        away = float(np.linalg.norm(hand.to_goal))
        if self._placed and away > _ASTRAY:
            self._placed, self._left = False, 0.0
        if hand.holds and away < _PLACED and np.linalg.norm(hand.body_velocity) < _STILL:
            self._placed, self._on, self._left = True, False, self._time(0.5, 2.0)
        if hand.touches:
            self._left -= self._dt
        if hand.touches and not self._placed and self._left <= 0.0:
            self._on = not (self._on and self._errs and away > _ERRING)
            self._left = self._time(0.3, 1.2) if self._on else self._time(0.5, 1.5)
        if self._placed:
            leaves = hand.touches and not hand.holds and self._left <= 0.0
            return hand.back_off() if leaves else hand.stop()
        if not hand.touches:
            return hand.approach()
        return hand.carry() if self._on else hand.press()


class CarryExpert(_Expert):
    """Carries the target to the goal with a grip that begins and ends by itself.

    It presses a target that it touches but does not hold. Where that does not help, it notices
    after 0.2 to ``patience`` s, backs off, and touches again. At the goal it rests. ``noise`` and
    ``correlation_steps`` are as in `SuctionExpert`.
    """

    def __init__(
        self, noise: float = 0.5, correlation_steps: float = 2.0, patience: float = 0.8
    ) -> None:
        super().__init__(noise, correlation_steps)
        self._patience = patience
        self._pressing, self._backing = 0.0, 0.0

    def _begin(self) -> None:
        self._pressing, self._backing = self._time(0.2, self._patience), 0.0

    def _force(self, hand: GripperForces) -> np.ndarray:
        if hand.holds:
            self._pressing = self._time(0.2, self._patience)
            return hand.carry()
        if self._backing > 0.0:
            self._backing -= self._dt
            return hand.back_off()
        if hand.placed:
            return hand.stop()
        if not hand.touches:
            return hand.approach()
        if not hand.helps:
            self._pressing -= self._dt
            if self._pressing <= 0.0:
                self._backing = self._time(0.1, 0.15)
                self._pressing = self._time(0.2, self._patience)
            return hand.accompany()
        return hand.press()


_GENTLE = 3.0
"""Force of a pull that ends no hold, N."""
_MOVES = 0.02
"""Speed above which a body is not welded, m/s."""
_NEAR = 0.1
"""Distance from the goal within which a body may rest, m."""


class LookAlikesExpert(_Expert):
    """Takes hold of the targets in random order, and carries the one that moves to the goal.

    It pulls gently for 0.3 to 0.6 s, tears itself off a body that has not moved by then, and goes
    to the next. It knows no more than what is observed. ``noise`` and ``correlation_steps`` are as
    in `SuctionExpert`.
    """

    _pulling = 0.0

    def _begin(self) -> None:
        self._shuffle()
        self._pulling = self._time(0.3, 0.6)

    def _force(self, hand: GripperForces) -> np.ndarray:
        if self._pulling <= 0.0:
            if hand.holds:
                return hand.tear()
            self._targets.append(self._targets.pop(0))
            self._pulling = self._time(0.3, 0.6)
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
    the goal it tears itself off. ``noise`` and ``correlation_steps`` are as in `SuctionExpert`.
    """

    def __init__(self, noise: float = 0.3, correlation_steps: float = 2.0) -> None:
        super().__init__(noise, correlation_steps)
        self._left = 0
        self._pressing, self._pulling = 0.0, 0.0
        self._found = False

    def _begin(self) -> None:
        self._shuffle()
        self._left = len(self._targets)
        self._begin_trial()

    def _begin_trial(self) -> None:
        self._pressing, self._pulling = self._time(1.4, 2.6), 0.2
        self._found = False

    def _force(self, hand: GripperForces) -> np.ndarray:
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
