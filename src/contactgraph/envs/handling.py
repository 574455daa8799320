"""A policy that handles bodies at random: it presses, pulls, carries and leaves them."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.carry_expert import approach_velocity, limited, unit
from contactgraph.envs.contract import Observation
from contactgraph.envs.exploration import NoisyPolicy
from contactgraph.envs.gripper_task import GRIPPER, MAX_FORCE
from contactgraph.envs.pickup import held
from contactgraph.envs.pickup_layout import HALF_WIDTH

_GAIN = 6.0
"""Of the velocity controller, N s/m for every body that moves."""
_LEAST_PRESS = 0.2
"""Force that keeps a pressed body touching, N."""
_PATIENCE = 3.0
"""Time of an approach before another body is chosen, s."""
_TEARING = 0.1
"""Time for which the gripper pulls with all its force when it leaves, s."""
_DURATION = {
    "press": (0.1, 1.5),
    "pull": (0.2, 0.6),
    "carry": (0.5, 1.5),
    "still": (0.2, 0.5),
    "leave": (0.2, 0.5),
}
"""Shortest and longest time of an action, s."""


class HandlingPolicy(NoisyPolicy):
    """Goes to a body, presses it on, pulls back, moves it about, leaves it, and goes to the next.

    It looks at positions and contacts, not at holding. A body is approached from the side from
    which pressing moves it towards a random point of the scene. A handling then is two to five
    actions: the gripper presses it on for 0.1 to 1.5 s, pulls back for 0.2 to 0.6 s, or moves it
    about for 0.5 to 1.5 s; in the end it stands still and leaves. Where contact is lost before, it
    leaves, or in half of the cases goes straight back: plans ask what happens then.

    Where the control has a switch, it is on at the start of half of the handlings, and changes
    0.7 times a second in them. Noise of 0.1 N on each axis is added to the force.
    """

    def __init__(self) -> None:
        super().__init__(noise=0.1)

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where there is nothing to handle."""
        if scene.node_count < 2 or not scene.actuated[GRIPPER]:
            raise InvalidInputError(
                f"handling needs an actuated node 0 and a body, found nodes {list(scene.node_name)}"
            )
        self._rng = np.random.default_rng(seed)
        super().reset(scene, int(self._rng.integers(2**31)))
        self._dt = scene.dt
        self._has_switch = "switch" in (scene.control_kind or ())
        self._action, self._left, self._body, self._switch = "leave", 0.0, 1, 0.0
        self._aim, self._strength, self._due, self._tearing = np.zeros(2), 0.0, 0, 0.0

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N, or ``[3]`` with the switch."""
        force = super().__call__(observation)
        if not self._has_switch:
            return force
        handles = self._action not in ("approach", "leave")
        if handles and self._rng.random() < 0.7 * self._dt:
            self._switch = 1.0 - self._switch
        return np.append(force, self._switch)

    def _choose_action(self, observation: Observation, touching: set[int]) -> None:
        """Begins the next action where the present one is over."""
        if self._action == "approach" and self._body in touching:
            self._due = int(self._rng.integers(2, 6))
            self._begin(self._drawn())
        elif self._action in ("approach", "leave"):
            if self._left <= 0.0:
                self._choose_body(observation["position"], touching)
        elif self._body not in touching and self._rng.random() < 0.5:
            own, body = (observation["position"][node] for node in (GRIPPER, self._body))
            self._approach(self._body, 2.0 * body - own)
        elif self._body not in touching or (self._action == "still" and self._left <= 0.0):
            self._begin("leave")
            self._switch, self._tearing = 0.0, self._left - _TEARING
        elif self._left <= 0.0:
            self._due -= 1
            self._begin(self._drawn() if self._due > 0 else "still")

    def _drawn(self) -> str:
        """An action of a handling."""
        return str(self._rng.choice(("press", "pull", "carry"), p=(0.7, 0.15, 0.15)))

    def _begin(self, action: str) -> None:
        self._action = action
        self._left = float(self._rng.uniform(*_DURATION[action]))
        self._strength = float(self._rng.uniform())
        self._aim = self._rng.uniform(-0.7 * HALF_WIDTH, 0.7 * HALF_WIDTH, 2)

    def _choose_body(self, position: np.ndarray, touching: set[int]) -> None:
        """The next body: often the outermost, so that none drifts far."""
        bodies = sorted(set(range(1, len(position))) - touching)
        if not bodies:  # all of them hold on to the gripper
            self._due = int(self._rng.integers(2, 6))
            self._begin("carry")
            return
        outermost = max(bodies, key=lambda node: float(np.linalg.norm(position[node])))
        body = outermost if self._rng.random() < 0.5 else int(self._rng.choice(bodies))
        self._approach(body, self._rng.uniform(-0.7 * HALF_WIDTH, 0.7 * HALF_WIDTH, 2))
        self._switch = float(self._rng.random() < 0.5)

    def _approach(self, body: int, aim: np.ndarray) -> None:
        self._action, self._left = "approach", _PATIENCE
        self._body, self._aim, self._strength = body, aim, float(self._rng.uniform())

    def _force(self, observation: Observation) -> np.ndarray:
        """``[2]`` N of the present action, without the noise."""
        touching = held(observation["contact"])
        self._left -= self._dt
        self._choose_action(observation, touching)
        position, velocity = observation["position"], observation["velocity"]
        mass = 1 + len(touching)
        gripper, body = position[GRIPPER], position[self._body]
        normal = unit(body - gripper)
        own, relative = velocity[GRIPPER], velocity[GRIPPER] - velocity[self._body]
        if self._action == "press":
            across = relative - normal * (normal @ relative)
            slow = float(own @ normal) < 0.15 + 0.35 * self._strength
            along = 0.4 + 1.2 * self._strength if slow else _LEAST_PRESS
            return along * normal - _GAIN * across
        if self._action == "pull":
            return -(2.0 + 10.0 * self._strength) * normal
        if self._action == "carry":
            wanted = limited(2.0 * (self._aim - gripper), 0.3 + 0.5 * self._strength)
        elif self._action == "still":
            wanted = np.zeros(2)
        elif self._action == "leave":
            if mass > 1 and self._left > self._tearing:  # tears off what still holds
                return -MAX_FORCE * normal
            wanted = -0.3 * normal
        else:
            speed, touch_speed = 0.5 + 0.5 * self._strength, 0.1 + 0.4 * self._strength
            direction = unit(self._aim - body)
            wanted = velocity[self._body] + approach_velocity(
                gripper - body, direction, speed, touch_speed
            )
        return limited(mass * _GAIN * (wanted - own), 6.0)
