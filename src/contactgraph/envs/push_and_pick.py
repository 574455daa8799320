"""Scripted pushing (behind the object as seen from its goal, push, steer) and picking."""

from dataclasses import dataclass, replace

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.exploration import CorrelatedNoise

NEAR_WEIGHTS = np.array([0.03, 0.03, 0.002, 0.002])
"""Costs in the plane of what pushes and the body, so small that it may go round the body."""

_BEHIND = np.deg2rad(30.0)
"""Within this angle of the line from goal to object the hand goes straight behind it."""
_LEVELLING = 8.0
"""1/s: wanted vertical velocity for each metre off the height of a push."""
_ROUND = np.deg2rad(40.0)
"""Angle by which it aims ahead on its way round the object."""


@dataclass(frozen=True, eq=False)
class PushStyle:
    """The lengths and speeds of a pushing hand."""

    clearance: float
    """m: distance of the centres of hand and object, in the plane, at which they cannot touch."""
    speed: float
    """m/s of the hand, on the way and in a push."""
    lead: float
    """s: a control is the hand's wanted velocity times this, from the hand's position on."""
    near_enough: float
    """m: distance of object and goal at which the hand rests."""
    steering: float = 2.0
    """1/s: wanted sideways velocity for each metre beside the line of the push."""
    approach: float = 2.0
    """1/s: wanted velocity for each metre to a point, and of a push for each metre to the goal."""
    height: float = 0.0
    """m in space: of the hand above the object's centre at the start."""
    reach: np.ndarray | None = None
    """[2, 2] m: corners of the area that the hand does not leave. None: there is no limit."""


class PushPolicy:
    """Pushes an object to the goal without a model and without search.

    The hand, the first actuated node, goes round the object (the first other node) to the far side
    as seen from the goal, and pushes towards it. It steers by staying on the line through goal and
    object, and goes round again where it has slid off. In space it does so at one height.

    ``noise`` m is the standard deviation of a displacement added to the control on each axis, so
    that the control is no function of the state. With ``variety`` above 0 every episode has its
    own speed, from ``1 - variety`` times the style's to all of it (gentle to rough), and its own
    point of contact, beside the object's middle by up to ``variety`` times half the clearance.
    """

    def __init__(self, style: PushStyle, noise: float = 0.0, variety: float = 0.0) -> None:
        self._style, self._variety = style, variety
        self._noise = CorrelatedNoise(noise, correlation_steps=3.0)

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where nothing can be pushed."""
        kinds = set(scene.control_kind or ())
        if scene.goal is None or scene.actuated.all() or not kinds & {"position", "displacement"}:
            raise InvalidInputError(
                "a pushing policy needs a goal, a node that is not actuated and a control that is "
                f"a position or displacement, found {list(scene.node_name)} and "
                f"{scene.control_kind}"
            )
        self._hand, self._object = int(scene.actuated.argmax()), int(scene.actuated.argmin())
        self._absolute = "position" in kinds
        rng = np.random.default_rng(seed)
        share, beside = rng.uniform(0.0, 1.0), rng.uniform(-1.0, 1.0)
        speed = (1.0 - self._variety * share) * self._style.speed
        self._drawn = replace(self._style, speed=speed)
        self._aside = self._variety * beside * self._style.clearance / 2.0
        self._noise.reset(scene.dimension, seed)
        self._pushing = False
        self._level: float | None = None

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[D]`` m."""
        return self.towards(observation["position"], observation["goal"])

    def towards(self, position: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """The control ``[D]`` m that pushes the object towards ``goal`` ``[D]`` m."""
        hand, at = position[self._hand], position[self._object]
        wanted = np.zeros(len(hand))
        wanted[:2] = self._velocity(hand[:2], at[:2], goal[:2])
        if self._style.reach is not None:
            low, high = (self._style.reach - hand[:2]) * self._style.approach
            wanted[:2] = np.clip(wanted[:2], low, high)
        if len(hand) == 3:
            if self._level is None:
                self._level = float(at[2]) + self._style.height
            wanted[2] = _LEVELLING * (self._level - hand[2])
        control = self._style.lead * wanted + self._noise()
        return hand + control if self._absolute else control

    def _velocity(self, hand: np.ndarray, at: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """The wanted velocity ``[2]`` m/s of the hand in the plane."""
        style, missing = self._drawn, goal - at
        distance = float(np.linalg.norm(missing))
        if distance < style.near_enough:
            self._pushing = False
            return np.zeros(2)
        along = missing / distance
        across = np.array([-along[1], along[0]])
        beside = hand - at - self._aside * across
        back, off = -float(beside @ along), float(beside @ across)
        limit = style.clearance * (0.5 if self._pushing else 0.2)
        self._pushing = back > 0.0 and abs(off) < limit
        if self._pushing:
            speed = min(style.speed, style.approach * distance)
            return speed * along - style.steering * off * across
        angle = float(np.arctan2((hand - at) @ across, -(hand - at) @ along))
        away = float(np.linalg.norm(hand - at))
        if abs(angle) > _BEHIND and away < 0.9 * style.clearance:
            aim = at + 1.1 * style.clearance / max(away, 1e-6) * (hand - at)
        elif abs(angle) > _BEHIND:
            angle -= np.sign(angle) * _ROUND
            side = np.cos(angle) * -along + np.sin(angle) * across
            aim = at + 1.1 * style.clearance * side
        else:
            aim = at - style.clearance * along + self._aside * across
        velocity = 2.0 * style.approach * (aim - hand)
        return velocity * (style.speed / max(style.speed, float(np.linalg.norm(velocity))))


class RandomPushes(PushPolicy):
    """Explores: pushes the object in random directions, each for a random time.

    ``noise`` m is as for `PushPolicy`; ``seconds`` s is the mean time of a direction.
    """

    def __init__(self, style: PushStyle, noise: float = 0.0, seconds: float = 3.0) -> None:
        super().__init__(style, noise, variety=0.7)
        self._seconds = seconds

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises as `PushPolicy`."""
        super().reset(scene, seed)
        self._rng = np.random.default_rng([seed, 1])
        self._chance = scene.dt / self._seconds
        self._direction: np.ndarray | None = None

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[D]`` m."""
        position = observation["position"]
        if self._direction is None or self._rng.uniform() < self._chance:
            angle = self._rng.uniform(0.0, 2.0 * np.pi)
            self._direction = np.zeros(position.shape[1])
            self._direction[:2] = np.cos(angle), np.sin(angle)
        return self.towards(position, position[self._object] + self._direction)


_ABOVE = 0.08
"""m: height above the object at which the hand comes."""
_ALIGNED = 0.015
"""m beside the object within which the hand goes down."""
_DEEP = 0.01
"""m above the object's centre at which the fingers close."""
_CLOSING_S = 0.16
"""Time for which the fingers close before the hand lifts."""
_LOST = 0.05
"""m between hand and object at which a grasp has failed."""


class PickPolicy:
    """Grasps an object from above and takes it to the goal, without a model and without search.

    The control is a displacement ``[3]`` m of the hand and the fingers' command, 1 open to -1
    closed. ``speed`` m/s is the hand's, ``lead`` s as in `PushStyle`. ``noise`` m is the standard
    deviation of a displacement added on each axis. With ``variety`` above 0 every episode has its
    own speed, from ``1 - variety`` times ``speed`` to all of it.
    """

    def __init__(self, speed: float, lead: float, noise: float = 0.0, variety: float = 0.0) -> None:
        self._speed, self._lead, self._variety = speed, lead, variety
        self._noise = CorrelatedNoise(noise, correlation_steps=3.0)

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where nothing can be grasped."""
        wanted = ("displacement", "displacement", "displacement", "other")
        if scene.goal is None or scene.control_kind != wanted:
            raise InvalidInputError(
                f"a picking policy needs a goal and a control of {', '.join(wanted)}, found "
                f"{scene.control_kind}"
            )
        share = np.random.default_rng(seed).uniform(0.0, 1.0)
        self._drawn, self._dt = (1.0 - self._variety * share) * self._speed, scene.dt
        self._noise.reset(3, seed)
        self._closing_s: float | None = None

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[4]``: m, m, m, and the fingers' command."""
        hand, at = observation["position"]
        offset = at - hand
        if self._closing_s is not None and np.linalg.norm(offset) > _LOST:
            self._closing_s = None
        if self._closing_s is None and np.linalg.norm(offset[:2]) < _ALIGNED and -offset[2] < _DEEP:
            self._closing_s = 0.0
        if self._closing_s is None:
            beside = np.linalg.norm(offset[:2])
            above = _ABOVE if beside > _ALIGNED else 0.0
            return self._control(offset + np.array([0.0, 0.0, above]), 1.0)
        self._closing_s += self._dt
        if self._closing_s <= _CLOSING_S:
            return self._control(np.zeros(3), -1.0)
        return self._control(observation["goal"] - at, -1.0)

    def _control(self, missing: np.ndarray, fingers: float) -> np.ndarray:
        wanted = missing / (4.0 * self._dt)
        size = float(np.linalg.norm(wanted))
        if size > self._drawn:
            wanted = wanted * (self._drawn / size)
        return np.append(self._lead * wanted + self._noise(), fingers)
