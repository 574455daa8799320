"""A task in one file, used by its name `module:Class` wherever a command takes a TASK.

Usage: python examples/extend_task.py
or, in this folder:
    contactgraph collect extend_task:Line --distractors 1 --out line.h5
    contactgraph control pickup extend_task:Line --episodes 10
"""

from functools import partial

import numpy as np

from contactgraph.data import Scene
from contactgraph.envs import ChainCost, PickupExpert, check_task
from contactgraph.envs.grip import HoldAtTouch
from contactgraph.envs.gripper_task import DT, GRIPPER, GripperTask
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.planar.world import PlanarWorld
from contactgraph.evaluate import run_episode

TARGET, RADIUS = 1, 0.04  # m


class Line(GripperTask):
    """Gripper, target and goal lie on one line; distractors rest beside it.

    An option of the command line is an argument of `__init__` with the same name.
    """

    expert = PickupExpert  # makes the policy that collect records; without it, random forces
    demonstrator = partial(PickupExpert, noise=0.0)  # the same for collect --expert demo
    horizon = 20  # steps that control plans ahead by default

    def __init__(self, distractors: int = 0) -> None:
        super().__init__(count=2 + distractors, max_steps=120, extent=1.0)
        self.distractors = distractors

    def begin(self, seed: int) -> tuple[Scene, PlanarWorld]:
        rng = np.random.default_rng(seed)
        x = np.cumsum(rng.uniform(0.3, 0.6, 3)) - 0.9  # gripper, target, goal
        beside = [(0.3 * index, 0.5) for index in range(self.distractors)]
        position = np.array([(x[0], 0.0), (x[1], 0.0), *beside])
        count = len(position)
        scene = Scene(
            node_name=("gripper", "target", *(f"distractor-{i}" for i in range(count - 2))),
            node_type=("gripper", *["object"] * (count - 1)),
            actuated=np.arange(count) == GRIPPER,
            dt=DT,
            goal=np.array([x[2], 0.0]),
            radius=np.full(count, RADIUS),
            metadata={"task": "line", "seed": seed},
        )
        bodies = [PlanarBody(place, mass=1.0, radius=RADIUS) for place in position]
        return scene, PlanarWorld(bodies, DT, hold=HoldAtTouch())

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        return bool(np.linalg.norm(position[TARGET] - scene.goal) < 0.1)

    def cost_terms(self) -> ChainCost:
        return ChainCost((GRIPPER, TARGET), [3.0, 3.0, 0.2, 0.2], [50.0, 50.0, 1.0, 1.0], 0.01)


if __name__ == "__main__":
    check_task(Line)
    trajectory = run_episode(Line(distractors=2), PickupExpert(), seed=0)
    success = trajectory.scene.metadata["success"]
    print(f"Line meets the task contract; the expert's success: {success}")
