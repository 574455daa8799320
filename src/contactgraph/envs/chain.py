"""The task ``chain``: a gripper drags two links, joined by a hinge, over a table."""

from dataclasses import replace

import numpy as np

from contactgraph.data import Scene
from contactgraph.envs.gripper_task import DT, MASS, GripperTask
from contactgraph.envs.pickup import PickupExpert
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.planar.world import PlanarWorld
from contactgraph.envs.shaped_tasks import box_outline

LINK = np.array([0.1, 0.015])
"""Half the sides of a link of the chain, m."""
LINK_MASS = 0.3
"""kg"""
LINK_DAMPING = 3.0
"""1/s, of a link's velocity and angular velocity, by the table."""
SUBSTEPS = 50
"""With 10, a gripper that presses the target aside pulls a pin apart by 1.5 mm; so by 0.02 mm."""
CHAIN_STEPS = 160
GRASP_RADIUS = 0.03
"""Of the gripper, m."""


class ChainTask(GripperTask):
    """A gripper drags two links, joined by a hinge, to a goal.

    Nodes are the gripper (0), a disc of 1 kg and radius 3 cm that does not rotate, and two bars of
    20 by 3 cm and 0.3 kg, the link and the target. The gripper holds an end of the link by a pin,
    and a pin joins the link to the target, which starts in line with it; an observation has the key
    ``holding``, and what is held is in contact. The table damps the links by 3 1/s. The control
    ``[2]`` N is a force on the gripper. An episode runs for 160 steps of 0.05 s, and succeeds if
    the target's middle is within 0.1 m of the goal at its end. ``engine``: see `PlanarWorld`.
    """

    name = "chain"
    expert = PickupExpert
    chain = (2,)
    observes_holding = observes_turning = True

    def __init__(self, engine: str | None = None) -> None:
        super().__init__(3, CHAIN_STEPS, 1.5)
        self._engine = engine

    def begin(self, seed: int) -> tuple[Scene, PlanarWorld]:
        """Samples the scene of a seed, with everything at rest."""
        rng = np.random.default_rng(seed)
        gripper, goal = rng.uniform(-1.0, 1.0, (2, 2))
        angle = rng.uniform(-np.pi, np.pi)
        along = 2.0 * LINK[0] * np.array([np.cos(angle), np.sin(angle)])
        bar = PlanarBody(
            gripper, LINK_MASS, half_size=LINK, angle=angle, rotates=True, damping=LINK_DAMPING
        )
        links = [replace(bar, position=gripper + share * along) for share in (0.5, 1.5)]
        bodies = [PlanarBody(gripper, MASS, radius=GRASP_RADIUS), *links]
        world = PlanarWorld(bodies, DT, SUBSTEPS, engine=self._engine)
        world.join(0, 1)
        world.join(1, 2)
        end = LINK * [1.0, 0.0]
        scene = Scene(
            node_name=("gripper", "link", "target"),
            node_type=("gripper", "link", "link"),
            actuated=np.array([True, False, False]),
            dt=DT,
            goal=goal,
            mass=np.array([MASS, LINK_MASS, LINK_MASS]),
            control_kind=("force", "force"),
            polygons=(box_outline(LINK), box_outline(LINK)),
            polygon_of=np.array([1, 2]),
            pins=np.array([[0, 1], [1, 2]]),
            pin_points=np.array([[[0.0, 0.0], -end], [end, -end]]),
            metadata={"damping": LINK_DAMPING},
        )
        return scene, world
