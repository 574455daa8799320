"""Tasks of relations without contact: hidden springs, and one-way attraction within a radius."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import scipy

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Observation
from contactgraph.envs.gripper_task import GripperTask

MAX_BODIES = 20
SPRING_STIFFNESS = 0.1
"""N/m; bodies have 1 kg. This and what follows on springs is `SpringSim` of Kipf et al. 2018 (NRI),
whose unit of length is taken for 1 m and of time for 1 s; its walls, 5 m from the middle, are left
out, because hardly any body gets there."""
SPRING_SHARE = 0.5
"""Probability that a pair is joined."""
SPRING_SPREAD = 0.5
"""Standard deviation of the first positions on each axis, m."""
SPRING_SPEED = 0.5
"""Of every body at the start, m/s."""
SPRING_DT, SPRING_STEPS = 0.1, 49
ATTRACTION_RADIUS = 0.6
"""Distance from which on a puller does not act, m."""
ATTRACTION = 0.6
"""Acceleration of a follower close to a puller, m/s^2; it falls linearly to 0 at the radius."""
SOFTENING = 0.05
"""Distance within which the pull falls to 0 again, where its direction is lost, m."""
ATTRACTION_EXTENT = 0.8
"""Half the sides of the square of the first positions, m."""
ATTRACTION_SPEED = 0.1, 0.4
"""Of every body at the start, at least and at most, m/s."""
ATTRACTION_DT, ATTRACTION_STEPS = 0.05, 80
_TOLERANCE = 1e-10
_GOAL_RADIUS = 0.1

Acceleration = Callable[[np.ndarray], np.ndarray]
"""Accelerations ``[N, 2]`` m/s^2 from positions ``[N, 2]`` m."""
Related = Callable[[np.ndarray], np.ndarray]
"""``[N, N]`` bool: which pairs act on each other, from positions."""


class SmoothWorld:
    """Bodies under smooth accelerations, integrated to ten digits (DOP853)."""

    def __init__(
        self,
        position: np.ndarray,
        velocity: np.ndarray,
        acceleration: Acceleration,
        related: Related,
        dt: float,
    ) -> None:
        self.position, self.velocity = position, velocity
        self._acceleration, self._related, self._dt = acceleration, related, dt

    @property
    def contact(self) -> np.ndarray:
        """[N, N] bool: the pairs that act on each other, or one on the other."""
        return self._related(self.position)

    def step(self, force: np.ndarray) -> None:
        """Advances by a time step; ``force`` [N, 2] N, on bodies of 1 kg."""
        shape = self.position.shape

        def derivative(_: float, state: np.ndarray) -> np.ndarray:
            position, velocity = state.reshape(2, *shape)
            return np.concatenate([velocity, self._acceleration(position) + force]).ravel()

        first = np.concatenate([self.position, self.velocity]).ravel()
        limits = {"rtol": _TOLERANCE, "atol": _TOLERANCE, "max_step": 0.25 * self._dt}
        solved = scipy.integrate.solve_ivp(derivative, (0.0, self._dt), first, "DOP853", **limits)
        self.position, self.velocity = solved.y[:, -1].reshape(2, *shape)


class PassiveTask(GripperTask):
    """Bodies that nothing drives: the control is empty.

    Raises `InvalidInputError` where the number of bodies is not in 2 to 20.
    """

    name = "passive"

    def __init__(self, bodies: int, max_steps: int, dt: float) -> None:
        if not 2 <= bodies <= MAX_BODIES:
            raise InvalidInputError(f"objects must be 2 to {MAX_BODIES}, found {bodies}")
        super().__init__(bodies, max_steps, 5.0, dt=dt)
        self.action_space = gymnasium.spaces.Box(0.0, 0.0, (0,), np.float64)
        self._dt = dt

    @abstractmethod
    def sample(self, rng: np.random.Generator) -> tuple[SmoothWorld, tuple[str, ...]]:
        """The world at the start of an episode, and the types of its bodies."""

    def begin(self, seed: int) -> tuple[Scene, SmoothWorld]:
        """Samples the scene of a seed."""
        world, types = self.sample(np.random.default_rng(seed))
        scene = Scene(
            node_name=tuple(f"{kind}-{index}" for index, kind in enumerate(types)),
            node_type=types,
            actuated=np.zeros(len(types), bool),
            dt=self._dt,
            goal=np.zeros(2),
            mass=np.ones(len(types)),
            control_kind=(),
            metadata={"task": self.name, "seed": seed, **self.constants},
        )
        return scene, world

    @property
    def constants(self) -> dict[str, float | str]:
        """The constants of the world, for the metadata."""
        return {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advances by a time step; ``action`` is empty."""
        world = self.running()
        world.step(np.zeros_like(world.position))
        return self.stepped({})

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether the first body is within 0.1 m of the middle: there is nothing to achieve."""
        return float(np.linalg.norm(position[0] - scene.goal)) <= _GOAL_RADIUS

    def cost_terms(self) -> ChainCost:
        """The first body to the middle."""
        weights = np.array([50.0, 50.0, 1.0, 1.0])
        return ChainCost((0,), pick_weights=weights, goal_weights=weights, control_weight=0.01)


class SpringsTask(PassiveTask):
    """Bodies on springs that nothing shows; a `contactgraph.envs.Task`.

    Every pair is joined with probability 1/2 for a whole episode, by a spring of rest length 0:
    the force on body i is ``-k (x_i - x_j)``. Contacts are the joined pairs.
    """

    name = "springs"

    def __init__(self, bodies: int = 5) -> None:
        super().__init__(bodies, SPRING_STEPS, SPRING_DT)
        self._bodies = bodies

    def sample(self, rng: np.random.Generator) -> tuple[SmoothWorld, tuple[str, ...]]:
        """Positions normally distributed, all speeds equal, half the pairs joined."""
        count = self._bodies
        joined = np.triu(rng.random((count, count)) < SPRING_SHARE, 1)
        joined = joined | joined.T
        position = SPRING_SPREAD * rng.standard_normal((count, 2))
        velocity = rng.standard_normal((count, 2))
        velocity *= SPRING_SPEED / np.linalg.norm(velocity, axis=1, keepdims=True)
        laplacian = SPRING_STIFFNESS * (np.diag(joined.sum(axis=1)) - joined)
        world = SmoothWorld(
            position, velocity, lambda x: -laplacian @ x, lambda x: joined, SPRING_DT
        )
        return world, ("ball",) * count

    @property
    def constants(self) -> dict[str, float | str]:
        """Stiffness of a spring, and the probability of one."""
        return {"stiffness": SPRING_STIFFNESS, "spring_share": SPRING_SHARE}


class AttractionTask(PassiveTask):
    """Pullers attract followers within a radius, and nothing attracts pullers.

    A `contactgraph.envs.Task`. Two of the bodies are pullers, which go straight on; bodies pass
    through one another. Contacts are the pairs of a puller and a follower within the radius. They
    are symmetric as everywhere; that the first type acts on the second alone is the metadata's
    ``one_way``, "puller -> follower".
    """

    name = "attraction"

    def __init__(self, bodies: int = 6) -> None:
        super().__init__(bodies, ATTRACTION_STEPS, ATTRACTION_DT)
        self._types = ("puller",) * min(2, bodies - 1) + ("follower",) * max(1, bodies - 2)

    def sample(self, rng: np.random.Generator) -> tuple[SmoothWorld, tuple[str, ...]]:
        """Positions uniform in a square, speeds uniform between two bounds."""
        count = len(self._types)
        position = rng.uniform(-ATTRACTION_EXTENT, ATTRACTION_EXTENT, (count, 2))
        speed, heading = rng.uniform(*ATTRACTION_SPEED, count), rng.uniform(-np.pi, np.pi, count)
        velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        pulls = np.array([kind == "puller" for kind in self._types])
        acts = pulls[None, :] & ~pulls[:, None]
        """[N, N] whether the second body acts on the first."""

        def acceleration(position: np.ndarray) -> np.ndarray:
            offset = position[None, :] - position[:, None]
            distance = np.linalg.norm(offset, axis=-1)
            pull = ATTRACTION * np.maximum(1.0 - distance / ATTRACTION_RADIUS, 0.0) * acts
            soft = np.sqrt(distance**2 + SOFTENING**2)
            return np.einsum("ij,ijd->id", pull / soft, offset)

        def related(position: np.ndarray) -> np.ndarray:
            distance = np.linalg.norm(position[None, :] - position[:, None], axis=-1)
            return (acts | acts.T) & (distance < ATTRACTION_RADIUS)

        return SmoothWorld(position, velocity, acceleration, related, ATTRACTION_DT), self._types

    @property
    def constants(self) -> dict[str, float | str]:
        """Radius, the greatest pull, and the direction of the relation."""
        radius, pull = ATTRACTION_RADIUS, ATTRACTION
        return {"radius_m": radius, "pull_m_s2": pull, "one_way": "puller -> follower"}
