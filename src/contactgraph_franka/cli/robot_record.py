"""``contactgraph robot record``: runs of the scripted expert on an arm."""

import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from contactgraph_franka.cli.robot_options import ArmOptions

if TYPE_CHECKING:
    from contactgraph.data import Trajectory
    from contactgraph_franka.cli.robot_arms import Arm
    from contactgraph_franka.envs.pickup import ArmLayout
    from contactgraph_franka.robot import SafetyLimits

_SHORTEST_S = 1.0
"""What was recorded before a stop is kept where it lasted so long."""


@dataclass(frozen=True)
class Record:
    """Record runs of the scripted expert on an arm, to train on; goes on where it was stopped.

    Every run has its own start, goal and place of the block, by its number and the seed; in a
    rehearsal the block is put there, else a person is asked to. Every run is kept as it ends.
    """

    address: Positional[Annotated[str, arg(metavar="ADDR")]]
    """The arm's address, one in a rehearsal, or fake."""
    out: Annotated[Path, arg(metavar="FILE")]
    """The dataset file (HDF5); runs that are in it already count."""
    runs: int = 30
    """How many runs the file is to have."""
    seconds: float = 10.0
    """For how long each goes on."""
    seed: int = 0
    """The same seed has the same starts, goals and noise."""
    noise: Annotated[float, arg(metavar="N")] = 0.5
    """Standard deviation of the force added on each axis: it tells masses from drags."""
    arm: ArmOptions = field(default_factory=ArmOptions)

    def run(self) -> None:
        """Record and write."""
        from contactgraph.cli.options import check_range, check_seed
        from contactgraph.cli.output import check_writable, progress, say
        from contactgraph.data import InvalidInputError, Metadata, write_trajectories
        from contactgraph_franka.cli.robot_arms import opened
        from contactgraph_franka.cli.robot_fault import RobotFault
        from contactgraph_franka.cli.robot_options import check_seconds
        from contactgraph_franka.cli.robot_planners import expert_planner
        from contactgraph_franka.cli.robot_session import Session
        from contactgraph_franka.cli.robot_watch import ctrl_c
        from contactgraph_franka.loop import PlanningProcess

        check_writable(self.out)
        check_range("--runs", self.runs, 1, 1000)
        check_seed(self.seed)
        check_seconds("--seconds", self.seconds)
        if not 0.0 <= self.noise < math.inf:
            raise InvalidInputError(f"--noise must be at least 0, found {self.noise}")
        limits = self.arm.limits(self.address)
        done = self._done()
        if len(done) >= self.runs:
            say(f"{self.out}: has its {len(done)} runs already")
            return
        told: Metadata = {"task": "franka", "seed": self.seed, "noise": self.noise}
        make = partial(expert_planner, self.noise)
        with (
            opened(self.address, self.arm) as arm,
            PlanningProcess(make) as planning,
            progress("recording", self.runs) as steps,
        ):
            session = Session(arm, limits, planning, self.seconds)
            for number in range(len(done), self.runs):
                layout = self._layout(number, limits)
                self._arrange(arm, layout)
                with ctrl_c() as pressed:
                    report = session.run(layout.goal, _run_seed(self.seed, number), pressed)
                run = session.recorded(
                    layout.goal, {"number": number, "policy": "FrankaExpert", "seed": self.seed}
                )
                if run is not None and run.steps * run.scene.dt >= _SHORTEST_S:
                    done.append(run)
                    write_trajectories(self.out, done, told)
                if not report.completed:
                    reason = f"{report.stop.reason.value}. {arm.said()}".strip()
                    raise RobotFault(
                        f"run {number} stopped: {reason} {self.out} has {len(done)} runs; the same "
                        "command goes on from there"
                    )
                held = "held at the goal" if session.ended(layout.goal).success else "not brought"
                if pressed():
                    break
                steps.advance(number + 1, f"{held}, {report.rate_hz:.0f} Hz")
        say(f"{self.out}: {len(done)} runs of {self.runs}")
        if done:
            succeeded = sum(bool(run.scene.metadata.get("success")) for run in done)
            say(f"the expert succeeded in {succeeded} of {len(done)} runs")

    def _done(self) -> "list[Trajectory]":
        """What the file holds already."""
        from contactgraph.data import InvalidInputError, read_trajectories

        if not self.out.exists():
            return []
        found = read_trajectories(self.out)
        if found.metadata.get("seed") != self.seed or found.metadata.get("noise") != self.noise:
            raise InvalidInputError(
                f"{self.out}: was recorded with --seed {found.metadata.get('seed')} --noise "
                f"{found.metadata.get('noise')}; go on with these, or name another file"
            )
        return list(found)

    def _layout(self, number: int, limits: "SafetyLimits") -> "ArmLayout":
        import numpy as np

        from contactgraph_franka.envs.pickup import sample_layout, sweep_fits

        random = np.random.default_rng([self.seed, number])
        low, high = np.array(limits.workspace_low), np.array(limits.workspace_high)
        while True:
            layout = sample_layout(random, 0)
            if sweep_fits(layout.hand, layout.blocks[0], low, high):
                return layout

    def _arrange(self, arm: "Arm", layout: "ArmLayout") -> None:
        """Hand and block to where the run begins."""
        from contactgraph_franka.cli.robot_watch import count_down, wait_for_block

        hand = ", ".join(f"{number:.2f}" for number in layout.hand)
        count_down(arm, f"the hand opens and moves slowly to ({hand}) m")
        arm.move_to(layout.hand, layout.yaw)
        if not arm.arrange(layout):
            x, y, _ = layout.blocks[0]
            input(f"Put the block at ({x:.2f}, {y:.2f}) m, a side towards the hand; then Enter ")
        wait_for_block(arm)
        goal = ", ".join(f"{number:.2f}" for number in layout.goal)
        count_down(arm, f"the hand will sweep through the block and bring it to ({goal}) m")


def _run_seed(seed: int, number: int) -> int:
    import numpy as np

    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
