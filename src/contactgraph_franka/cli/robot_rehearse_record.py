"""``contactgraph robot rehearse-record``: a rehearsal, and runs recorded in it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

if TYPE_CHECKING:
    from contactgraph.data import Trajectory
    from contactgraph_franka.cli.rehearsed_arm import RehearsedArm
    from contactgraph_franka.cli.robot_session import Session
    from contactgraph_franka.loop import Planner

_AGAIN = 6
"""Times that another run is begun where one was stopped, before the whole is given up."""
_MOST_RUNS = 1000
"""In a file."""
_SHORTEST = 0.5
"""Of a run's time, what must have been recorded for it to count."""


@dataclass(frozen=True)
class RehearseRecord:
    """Rehearse an arm and record runs of it, seen by its camera; goes on where it was stopped.

    In some runs the block is picked up, at rest or in passing, and carried from place to place, in
    others the hand moves beside it. Contacts are the simulation's, for judging what is found
    without a sensor: training reads none. Beside FILE.h5 it writes FILE.truth.h5, the same runs as
    they really were, and FILE.live.h5, as they were known while they went on: not smoothed by what
    was seen later.
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
    stopping: float = 0.5
    """The share of grasps at rest; the others are in passing, as all of the paper's are."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write how well the block was seen, and what the loop held, to this file."""

    def run(self) -> None:
        """Record and write."""
        from contactgraph.cli.options import check_range, check_seed, check_share
        from contactgraph.cli.output import check_writable, say, write_json
        from contactgraph_franka.cli.robot_options import check_seconds

        for path in (self.out, self.json):
            check_writable(path)
        check_range("--runs", self.runs, 1, _MOST_RUNS)
        check_seed(self.seed)
        check_seconds("--seconds", self.seconds, 25.0)
        check_share("--stopping", self.stopping)
        paths = [self.out, *(self.out.with_suffix(f".{name}.h5") for name in ("truth", "live"))]
        kept = [self._done(path) for path in paths]
        # A process that was ended between two files has one run more in one of them.
        count = min(map(len, kept))
        kept = [runs[:count] for runs in kept]
        if count < self.runs:
            self._record(paths, kept)
        done, true, _ = kept
        values = _summary(done, true)
        write_json(self.json, {"data": str(self.out), "seed": self.seed, **values})
        say(
            f"{self.out}: {len(done)} runs, {values['completed']} of them to their end; the block "
            f"is off by {1e3 * values['position_error_m']:.2f} mm (median), "
            f"{1e3 * values['position_error_worst_m']:.1f} mm (worst)"
        )

    def _record(self, paths: list[Path], kept: "list[list[Trajectory]]") -> None:
        """Records what is missing, and writes after every run."""
        from functools import partial

        from contactgraph.cli.output import progress
        from contactgraph.data import Metadata, write_trajectories
        from contactgraph_franka.cli.rehearsed_arm import rehearsed_arm
        from contactgraph_franka.cli.robot_session import Session
        from contactgraph_franka.loop import PlanningProcess

        told: Metadata = {"task": "franka", "seed": self.seed}
        with (
            rehearsed_arm(self.pace) as stage,
            PlanningProcess(partial(recording_planner, self.stopping)) as planning,
            progress("recording", self.runs) as steps,
        ):
            session = Session(stage.arm, stage.limits, planning, self.seconds)
            for number in range(len(kept[0]), self.runs):
                made = self._recorded(stage, session, number)
                for path, runs, run in zip(paths, kept, made, strict=True):
                    runs.append(run)
                    write_trajectories(path, runs, told)
                steps.advance(number + 1, f"{made[0].steps} steps")

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
    ) -> "tuple[Trajectory, Trajectory, Trajectory]":
        """A run, how it really was, and as it was known while it went on."""
        from contactgraph.data import Metadata
        from contactgraph_franka.cli.rehearsed_arm import run_layout, run_seed
        from contactgraph_franka.cli.robot_fault import RobotFault
        from contactgraph_franka.envs.recording_policy import grasps
        from contactgraph_franka.sim.shared_state import ground_truth_trajectory

        for attempt in range(_AGAIN):
            # Where the arm hides the block for too long, it does so each time: another one then.
            draw = number + attempt * _MOST_RUNS
            seed = run_seed(self.seed, draw)
            layout = run_layout(self.seed, draw, stage.limits)
            stage.arrange(layout)
            report = session.run(layout.goal, seed, lambda: False)
            told: Metadata = {
                "number": number,
                "policy": "RecordingPolicy",
                "grasp": grasps(seed),
                "attempt": attempt,
                "completed": report.completed,
                "end": report.stop.reason.value,
                "rate_hz": report.rate_hz,
            }
            run = session.recorded(layout.goal, told)
            live = session.recorded(layout.goal, told, smooth=False)
            if run is None or live is None:
                continue
            if run.steps >= _SHORTEST * self.seconds / run.scene.dt:
                truth = ground_truth_trajectory(stage.rehearsal.ground_truth, run, session.began)
                labelled = [replace(each, contact=truth.contact) for each in (run, live)]
                return labelled[0], truth, labelled[1]
        raise RobotFault(
            f"run {number} stopped {_AGAIN} times, at last: {report.stop.reason.value}"
        )


def _summary(done: "list[Trajectory]", true: "list[Trajectory]") -> dict[str, Any]:
    """What recording came to, all runs together."""
    import numpy as np

    from contactgraph_franka.envs.pickup import HAND, TARGET

    off = [run.position - truth.position for run, truth in zip(done, true, strict=True)]
    error = np.concatenate([np.linalg.norm(each, axis=2) for each in off])
    told = [run.scene.metadata for run in done]
    return {
        "runs": len(done),
        "steps": sum(run.steps for run in done),
        "completed": sum(bool(one["completed"]) for one in told),
        "with_grasp": sum(bool(one["grasp"]) for one in told),
        "held_at_some_time": sum(
            bool(truth.contact[:, HAND, TARGET].any())
            for truth in true
            if truth.contact is not None
        ),
        "pace": [float(one["pace"]) for one in told],
        "rate_hz": min(float(one["rate_hz"]) for one in told),
        "position_error_m": float(np.median(error[:, TARGET])),
        "position_error_p95_m": float(np.percentile(error[:, TARGET], 95.0)),
        "position_error_worst_m": float(error[:, TARGET].max()),
        "hand_error_worst_m": float(error[:, HAND].max()),
        "each": told,
    }


def recording_planner(stopping: float) -> "Planner":
    """What `RecordingPolicy` asks for, in steps of 0.01 s; ``stopping`` is its share of stops."""
    import numpy as np

    from contactgraph_franka.envs.pickup import pickup_scene
    from contactgraph_franka.envs.recording_policy import RecordingPolicy
    from contactgraph_franka.loop.policy_planner import PolicyPlanner

    return PolicyPlanner(RecordingPolicy(stopping), pickup_scene(0.01, np.zeros(3)))
