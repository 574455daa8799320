"""A rehearsal with a camera, and an arm in it: for commands that do all of it by themselves."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from contactgraph_franka.cli.robot_arms import Arm
    from contactgraph_franka.cli.robot_options import ArmOptions
    from contactgraph_franka.envs.pickup import ArmLayout
    from contactgraph_franka.robot import SafetyLimits
    from contactgraph_franka.sim.simulated_robot import SimulatedRobot


@dataclass(frozen=True)
class RehearsedArm:
    """An arm, and what nobody knows of a real one."""

    arm: "Arm"
    rehearsal: "SimulatedRobot"
    limits: "SafetyLimits"

    def arrange(self, layout: "ArmLayout") -> None:
        """Hand and block to where a run begins; the camera sees the block."""
        from contactgraph_franka.cli.robot_watch import wait_for_block

        self.arm.move_to(layout.hand, layout.yaw)
        self.arm.arrange(layout)
        # Its track must forget where it stood before, and the block come to rest.
        self.arm.clock.wait_until(self.arm.clock() + 0.5)
        wait_for_block(self.arm)


@contextmanager
def rehearsed_arm(pace: float, options: "ArmOptions | None" = None) -> Iterator[RehearsedArm]:
    """Starts a rehearsal at a free address, ``pace`` times slower than real, and ends it."""
    from contactgraph_franka.cli.robot_arms import opened
    from contactgraph_franka.cli.robot_options import ArmOptions
    from contactgraph_franka.sim.camera import CameraSettings
    from contactgraph_franka.sim.simulated_robot import RobotSimulator

    chosen = ArmOptions(camera="rendered") if options is None else options
    with (
        RobotSimulator(pace=pace, camera=CameraSettings()) as rehearsal,
        opened(rehearsal.address, chosen) as arm,
    ):
        yield RehearsedArm(arm, rehearsal, chosen.limits(rehearsal.address))


def run_layout(seed: int, number: int, limits: "SafetyLimits") -> "ArmLayout":
    """Start, block and goal of a run: the same for the same ``seed`` and ``number``."""
    import numpy as np

    from contactgraph_franka.envs.pickup import sample_layout, sweep_fits

    random = np.random.default_rng([seed, number])
    low, high = np.array(limits.workspace_low), np.array(limits.workspace_high)
    while True:
        layout = sample_layout(random, 0)
        if sweep_fits(layout.hand, layout.blocks[0], low, high):
            return layout


def run_seed(seed: int, number: int) -> int:
    """Of whatever else is random about a run."""
    import numpy as np

    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
