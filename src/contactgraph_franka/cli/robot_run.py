"""``contactgraph robot run``: a model controls an arm."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from contactgraph_franka.cli.robot_options import ArmOptions

if TYPE_CHECKING:
    import numpy as np

    from contactgraph_franka.cli.robot_arms import Arm
    from contactgraph_franka.robot import SafetyLimits


@dataclass(frozen=True)
class Run:
    """Let an arm pick up a block and bring it to a goal, by MPC with a learned model."""

    run_name: Positional[Annotated[str, arg(metavar="RUN")]]
    """A run folder, a model file, or a model that ships with the package (franka)."""
    address: Positional[Annotated[str, arg(metavar="ADDR")]]
    """The arm's address, one in a rehearsal, or fake."""
    goal: Annotated[tuple[float, ...], arg(metavar="X Y Z")]
    """Where to bring the block, m, in the frame of the arm's base."""
    arm: ArmOptions = field(default_factory=ArmOptions)
    seconds: float = 5.0
    """For how long."""
    horizon: Annotated[int, arg(metavar="INT")] = 100
    """Steps to plan ahead."""
    infer_contacts: bool = False
    """Find contacts by how things move, besides what the fingers tell."""
    stay: bool = False
    """Begin where the hand is, in place of moving slowly to where it can sweep from."""
    dry_run: bool = False
    """Read, plan and say what would be done; the arm is sent nothing."""
    save: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the run to this dataset file (HDF5), in steps of 0.001 s."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the measurements to this file."""

    def run(self) -> None:
        """Run, and say how it went."""
        from contactgraph.cli.models import model_path
        from contactgraph.cli.options import check_range
        from contactgraph.cli.output import check_writable, say, write_json
        from contactgraph.data import write_trajectories
        from contactgraph_franka.cli.robot_arms import opened
        from contactgraph_franka.cli.robot_fault import RobotFault
        from contactgraph_franka.cli.robot_options import check_seconds, place
        from contactgraph_franka.cli.robot_planners import mpc_planner
        from contactgraph_franka.cli.robot_session import Session
        from contactgraph_franka.cli.robot_watch import count_down, ctrl_c, wait_for_block
        from contactgraph_franka.loop import PlanningProcess

        for path in (self.save, self.json):
            check_writable(path)
        check_seconds("--seconds", self.seconds)
        check_range("--horizon", self.horizon, 1, 1000)
        limits = self.arm.limits(self.address)
        goal = place("--goal", self.goal, limits)
        make = partial(
            mpc_planner,
            model_path(self.run_name),
            limits.max_force,
            self.horizon,
            self.infer_contacts,
        )
        with opened(self.address, self.arm) as arm:
            wait_for_block(arm)
            with PlanningProcess(make) as planning:
                session = Session(arm, limits, planning, self.seconds, self.dry_run)
                if not (self.dry_run or self.stay):
                    self._move_to_start(arm, goal, limits)
                count_down(arm, self._words(goal))
                with ctrl_c() as pressed:
                    report = session.run(goal, 0, pressed)
                said = "" if report.completed else arm.said()
            run = session.recorded(goal, {"model": self.run_name, "address": self.address})
        if run is not None and self.save is not None:
            write_trajectories(self.save, [run], {"task": "franka"})
        for line in report.lines():
            say(line)
        ended = session.ended(goal)
        write_json(
            self.json,
            {
                "run": self.run_name,
                "address": self.address,
                "goal": goal.tolist(),
                "dry_run": self.dry_run,
                "pace": arm.clock.pace,
                **ended.to_json(),
                **report.to_json(),
            },
        )
        if not report.completed:
            raise RobotFault(f"the arm stopped: {report.stop.reason.value}. {said}".strip())
        if not self.dry_run:
            say(ended.words)

    def _words(self, goal: "np.ndarray") -> str:
        where = ", ".join(f"{number:g}" for number in goal)
        if self.dry_run:
            return f"plans to bring the block to ({where}) m are made and said; nothing is sent"
        return (
            f"the hand will sweep through the block and bring it to ({where}) m within "
            f"{self.seconds:g} s, with at most {self.arm.max_force:g} N"
        )

    def _move_to_start(self, arm: "Arm", goal: "np.ndarray", limits: "SafetyLimits") -> None:
        import numpy as np

        from contactgraph_franka.cli.robot_fault import RobotFault
        from contactgraph_franka.cli.robot_session import seen_block
        from contactgraph_franka.cli.robot_watch import count_down
        from contactgraph_franka.envs.pickup import sweep_start, sweep_yaw

        block = seen_block(arm)
        low, high = np.array(limits.workspace_low), np.array(limits.workspace_high)
        hand = sweep_start(block, arm.block_yaw, goal, low, high)
        where = ", ".join(f"{number:.3f}" for number in block)
        if hand is None:
            raise RobotFault(
                f"the block at ({where}) m cannot be swept through within the workspace: put it "
                "nearer to the middle, or use --stay"
            )
        at = ", ".join(f"{number:.2f}" for number in hand)
        count_down(arm, f"the block is at ({where}) m; the hand first moves slowly to ({at}) m")
        arm.move_to(hand, sweep_yaw(hand, block))
