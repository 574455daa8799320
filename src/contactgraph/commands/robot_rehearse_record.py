"""``contactgraph robot rehearse-record``: a rehearsal, and runs recorded in it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

if TYPE_CHECKING:
    from contactgraph.commands.rehearsed_arm import RehearsedArm
    from contactgraph.commands.robot_session import Session
    from contactgraph.data import Trajectory
    from contactgraph.robot.loop import Planner

_AGAIN = 3
"""Times that a run that was stopped is begun, before the whole is given up."""
_SHORTEST = 0.5
"""Of a run's time, what must have been recorded for it to count."""


@dataclass(frozen=True)
class RehearseRecord:
    """Rehearse an arm and record runs of it, seen by its camera; goes on where it was stopped.

    In some runs the block is picked up and carried from place to place, in others the hand moves
    beside it. Contacts are the simulation's, for judging what is found without a sensor: training
    reads none. Beside FILE.h5 it writes FILE.truth.h5: the same runs as they really were.
    """

    out: Annotated[Path, arg(metavar="FILE")]
    """The dataset file (HDF5); runs that are in it already count."""
    runs: int = 30
    """How many runs the file is to have."""
    seconds: float = 10.0
    """For how long each goes on."""
    seed: int = 0
    """The same seed has the same starts, goals and noise."""
    pace: float = 4.0
    """Wall seconds to a simulated one."""

    def run(self) -> None:
        """Record and write."""
        from contactgraph.commands.numbers import check_range, check_seed
        from contactgraph.commands.output import check_writable, progress, say
        from contactgraph.commands.rehearsed_arm import rehearsed_arm
        from contactgraph.commands.robot_options import check_seconds
        from contactgraph.commands.robot_session import Session
        from contactgraph.data import Metadata, write_trajectories
        from contactgraph.robot.loop import PlanningProcess

        check_writable(self.out)
        check_range("--runs", self.runs, 1, 1000)
        check_seed(self.seed)
        check_seconds("--seconds", self.seconds, 25.0)
        done, true = self._done(self.out), self._done(self._truth)
        # A process that was ended between the two files has one run more in one of them.
        count = min(len(done), len(true))
        done, true = done[:count], true[:count]
        if count >= self.runs:
            say(f"{self.out}: has its {count} runs already")
            return
        told: Metadata = {"task": "franka", "seed": self.seed}
        with (
            rehearsed_arm(self.pace) as stage,
            PlanningProcess(recording_planner) as planning,
            progress("recording", self.runs) as steps,
        ):
            session = Session(stage.arm, stage.limits, planning, self.seconds)
            for number in range(count, self.runs):
                run, truth = self._recorded(stage, session, number)
                done.append(run)
                true.append(truth)
                write_trajectories(self.out, done, told)
                write_trajectories(self._truth, true, told)
                steps.advance(number + 1, f"{run.steps} steps")
            report = stage.rehearsal.report()
        say(f"{self.out}: {len(done)} runs; the server held {report.rate:.0f} ticks a second")

    @property
    def _truth(self) -> Path:
        return self.out.with_suffix(".truth.h5")

    def _done(self, path: Path) -> "list[Trajectory]":
        """What the file holds already."""
        from contactgraph.data import InvalidInputError, read_trajectories

        if not path.exists():
            return []
        found = read_trajectories(path)
        if found.metadata.get("seed") != self.seed:
            raise InvalidInputError(
                f"{path}: was recorded with --seed {found.metadata.get('seed')}; go on with it, or "
                "name another file"
            )
        return list(found)

    def _recorded(
        self, stage: "RehearsedArm", session: "Session", number: int
    ) -> "tuple[Trajectory, Trajectory]":
        """A run, and its truth."""
        from contactgraph.commands.rehearsed_arm import run_layout, run_seed
        from contactgraph.commands.robot_fault import RobotFault
        from contactgraph.data import Metadata
        from contactgraph.rehearsal.true_run import true_run
        from contactgraph.tasks.franka_recording import grasps

        seed = run_seed(self.seed, number)
        layout = run_layout(self.seed, number, stage.limits)
        for attempt in range(_AGAIN):
            stage.arrange(layout)
            report = session.run(layout.goal, seed, lambda: False)
            told: Metadata = {
                "number": number,
                "policy": "FrankaRecording",
                "grasp": grasps(seed),
                "attempt": attempt,
                "end": report.stop.reason.value,
                "rate_hz": report.rate_hz,
            }
            run = session.recorded(layout.goal, told)
            if run is not None and run.steps >= _SHORTEST * self.seconds / run.scene.dt:
                truth = true_run(stage.rehearsal.truth, run, session.began)
                return replace(run, contact=truth.contact), truth
        raise RobotFault(
            f"run {number} stopped {_AGAIN} times, at last: {report.stop.reason.value}"
        )


def recording_planner() -> "Planner":
    """What `FrankaRecording` asks for, in steps of 0.01 s."""
    import numpy as np

    from contactgraph.evaluate.policy_planner import PolicyPlanner
    from contactgraph.tasks.franka_pickup import pickup_scene
    from contactgraph.tasks.franka_recording import FrankaRecording

    return PolicyPlanner(FrankaRecording(), pickup_scene(0.01, np.zeros(3)))
