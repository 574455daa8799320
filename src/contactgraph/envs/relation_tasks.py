"""A task of relations without contact: springs that nothing shows."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy

from contactgraph.data import Scene
from contactgraph.envs.gripper_task import GripperTask, check_count

MAX_BODIES = 20
SPRING_STIFFNESS = 0.1
"""N/m; bodies have 1 kg. This and what follows is `SpringSim` of Kipf et al. 2018 (NRI), whose
unit of length is taken for 1 m and of time for 1 s; its walls, 5 m from the middle, are left out,
because hardly any body gets there."""
SPRING_SHARE = 0.5
"""Probability that a pair is joined."""
SPRING_SPREAD = 0.5
"""Standard deviation of the first positions on each axis, m."""
SPRING_SPEED = 0.5
"""Of every body at the start, m/s."""
SPRING_DT, SPRING_STEPS = 0.1, 49


class SpringWorld:
    """Bodies of 1 kg on springs of rest length 0 between joined pairs ``[N, N]``, moved exactly."""

    metadata: Mapping[str, Any] = {}
    """Of a scene: no simulator moves the bodies."""

    def __init__(
        self, position: np.ndarray, velocity: np.ndarray, joined: np.ndarray, dt: float
    ) -> None:
        self.position, self.velocity, self.contact = position, velocity, joined
        count = len(position)
        # With the state (position, velocity, force): its rate is linear in it.
        rate = np.zeros((3 * count, 3 * count))
        rate[:count, count : 2 * count] = np.eye(count)
        rate[count : 2 * count, :count] = SPRING_STIFFNESS * (joined - np.diag(joined.sum(axis=1)))
        rate[count : 2 * count, 2 * count :] = np.eye(count)
        self._moved = scipy.linalg.expm(dt * rate)

    def step(self, force: np.ndarray) -> None:
        """Advances by ``dt`` under a constant ``force`` ``[N, 2]`` N."""
        state = self._moved @ np.concatenate([self.position, self.velocity, force])
        self.position, self.velocity, _ = np.split(state, 3)


class SpringsTask(GripperTask):
    """Bodies move on springs that nothing shows; nothing is driven.

    Every pair is joined with probability 1/2 for a whole episode, by a spring of rest length 0:
    the force on body i is ``-k (x_i - x_j)``. Contacts are the joined pairs. The control is empty.
    Raises `InvalidInputError` where the number of bodies is not in 2 to 20.
    """

    name = "springs"
    chain = (0,)  # to the middle: there is nothing to achieve
    passive = True
    max_force = None

    def __init__(self, objects: int = 5) -> None:
        check_count("objects", objects, 2, MAX_BODIES)
        super().__init__(objects, SPRING_STEPS, 5.0, dt=SPRING_DT)
        self._bodies = objects

    def begin(self, seed: int) -> tuple[Scene, SpringWorld]:
        """Positions normally distributed, all speeds equal, half the pairs joined."""
        rng, count = np.random.default_rng(seed), self._bodies
        joined = np.triu(rng.random((count, count)) < SPRING_SHARE, 1)
        position = SPRING_SPREAD * rng.standard_normal((count, 2))
        velocity = rng.standard_normal((count, 2))
        velocity *= SPRING_SPEED / np.linalg.norm(velocity, axis=1, keepdims=True)
        scene = Scene(
            node_name=tuple(f"ball-{index}" for index in range(count)),
            node_type=("ball",) * count,
            actuated=np.zeros(count, bool),
            dt=SPRING_DT,
            goal=np.zeros(2),
            mass=np.ones(count),
            control_kind=(),
            metadata={"stiffness": SPRING_STIFFNESS, "spring_share": SPRING_SHARE},
        )
        return scene, SpringWorld(position, velocity, joined | joined.T, SPRING_DT)
