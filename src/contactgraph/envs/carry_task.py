"""The base of tasks in which a gripper carries bodies and geometry does not tell its holds."""

from abc import abstractmethod

import gymnasium
import numpy as np

from contactgraph.data import Scene
from contactgraph.envs.contract import ChainCost, Observation
from contactgraph.envs.gripper_task import (
    DT,
    GRIPPER,
    MASS,
    GripperTask,
    fixed_layout,
    fixed_metadata,
)
from contactgraph.envs.pickup import (
    CONTROL_WEIGHT,
    GOAL_WEIGHTS,
    MAX_DISTRACTORS,
    MAX_STEPS,
    PICK_WEIGHTS,
    TARGET,
    at_goal,
    check_counts,
    disc_scene,
)
from contactgraph.envs.pickup_layout import RADIUS, PickupLayout, extent, sample_layout
from contactgraph.envs.planar_body import PlanarBody
from contactgraph.envs.planar_world import SIMULATOR, HoldRule, PlanarWorld

Metadata = dict[str, str | int | float | bool]


class CarryTask(GripperTask):
    """Discs of 1 kg and radius 0.04 m without friction; the gripper alone holds, by a rule.

    Nodes are the gripper (0), ``targets`` targets (1, 2, ...) and ``distractors`` further bodies,
    all of one node type. An observation has the key ``holding`` ``[N, N]`` int8 beside ``contact``,
    which is touching or holding. An episode always runs for ``max_steps`` steps of
    0.05 s.

    A subclass defines the rule and the success of an episode.
    """

    name: str
    """Of the task, for the scene's metadata."""

    def __init__(
        self,
        distractors: int = 0,
        substeps: int = 10,
        fixed_seed: int | None = None,
        targets: int = 1,
        max_steps: int = MAX_STEPS,
    ) -> None:
        check_counts(distractors, substeps)
        super().__init__(1 + targets + distractors, max_steps, extent(targets))
        self.targets, self.distractors, self._substeps = targets, distractors, substeps
        self._fixed_seed = fixed_seed
        self._fixed = fixed_layout(
            fixed_seed, lambda rng: sample_layout(rng, targets, MAX_DISTRACTORS)
        )
        count = 1 + targets + distractors
        assert isinstance(self.observation_space, gymnasium.spaces.Dict)
        self.observation_space.spaces["holding"] = gymnasium.spaces.MultiBinary((count, count))

    @abstractmethod
    def hold_rule(self, seed: int) -> tuple[HoldRule, Metadata]:
        """The rule of an episode, with all randomness from ``seed``, and metadata of the scene."""

    def begin(self, seed: int) -> tuple[Scene, PlanarWorld]:
        """Samples the scene of a seed, with everything at rest."""
        layout = sample_layout(
            np.random.default_rng(seed), self.targets, self.distractors, self._fixed
        )
        # A stream of its own: the draws of the layout depend on the number of distractors.
        rule, drawn = self.hold_rule(int(np.random.SeedSequence([seed, 1]).generate_state(1)[0]))
        metadata: Metadata = {
            "task": self.name,
            "seed": seed,
            "distractors": self.distractors,
            "simulator": SIMULATOR,
            "substeps": self._substeps,
            **fixed_metadata(self._fixed_seed),
            **drawn,
        }
        names = ("target",) if self.targets == 1 else _numbered("target", self.targets)
        scene = disc_scene(layout, names, metadata)
        return scene, _world(layout, self._substeps, rule)

    def observed(self) -> Observation:
        """The observation of the present state, with what is held."""
        return {**super().observed(), "holding": self.carrying().holding.astype(np.int8)}

    def carrying(self) -> PlanarWorld:
        """The current episode's world."""
        world = self.world
        assert isinstance(world, PlanarWorld)
        return world

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether the target is within 0.1 m of the goal."""
        return at_goal(position[TARGET], scene)

    def cost_terms(self) -> ChainCost:
        """The weights of pickup: gripper to target, target to goal."""
        return ChainCost((GRIPPER, TARGET), PICK_WEIGHTS, GOAL_WEIGHTS, CONTROL_WEIGHT)


def _world(layout: PickupLayout, substeps: int, rule: HoldRule) -> PlanarWorld:
    bodies = [PlanarBody(position=centre, mass=MASS, radius=RADIUS) for centre in layout.position]
    return PlanarWorld(bodies, DT, substeps, rule)


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}-{index}" for index in range(1, count + 1))
