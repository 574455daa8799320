"""``contactgraph robot record``: runs of the scripted expert on an arm."""

import math
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from contactgraph_franka.cli.options import ArmOptions

if TYPE_CHECKING:
    from contactgraph.data import Trajectory
    from contactgraph_franka.cli.arms import Arm
    from contactgraph_franka.envs.pickup import ArmLayout
    from contactgraph_franka.safety import SafetyLimits

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
        from contactgraph.cli.output import check_writable, progress
        from contactgraph.data import InvalidInputError, Metadata, write_trajectories
        from contactgraph_franka.cli.arms import open_arm
        from contactgraph_franka.cli.control import expert_planner
        from contactgraph_franka.cli.options import RobotFault, check_seconds, ctrl_c
        from contactgraph_franka.cli.session import Session
        from contactgraph_franka.loop import PlannerProcess

        check_writable(self.out)
        check_range("--runs", self.runs, 1, 1000)
        check_seed(self.seed)
        check_seconds("--seconds", self.seconds)
        if not 0.0 <= self.noise < math.inf:
            raise InvalidInputError(f"--noise must be at least 0, found {self.noise}")
        limits = self.arm.limits(self.address)
        done = self._done()
        if len(done) >= self.runs:
            print(f"{self.out}: has its {len(done)} runs already")
            return
        told: Metadata = {"task": "franka", "seed": self.seed, "noise": self.noise}
        make = partial(expert_planner, self.noise)
        with (
            open_arm(self.address, self.arm) as arm,
            PlannerProcess(make) as planning,
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
        print(f"{self.out}: {len(done)} runs of {self.runs}")
        if done:
            succeeded = sum(bool(run.scene.metadata.get("success")) for run in done)
            print(f"the expert succeeded in {succeeded} of {len(done)} runs")

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
        from contactgraph_franka.cli.options import count_down, wait_for_block

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


if TYPE_CHECKING:
    from contactgraph.data import Trajectory
    from contactgraph_franka.cli.session import Session, SimulatedSetup
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
        from contactgraph.cli.output import check_writable, write_json
        from contactgraph_franka.cli.options import check_seconds

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
        print(
            f"{self.out}: {len(done)} runs, {values['completed']} of them to their end; the block "
            f"is off by {1e3 * values['position_error_m']:.2f} mm (median), "
            f"{1e3 * values['position_error_worst_m']:.1f} mm (worst)"
        )

    def _record(self, paths: list[Path], kept: "list[list[Trajectory]]") -> None:
        """Records what is missing, and writes after every run."""
        from functools import partial

        from contactgraph.cli.output import progress
        from contactgraph.data import Metadata, write_trajectories
        from contactgraph_franka.cli.session import Session, simulated_setup
        from contactgraph_franka.loop import PlannerProcess

        told: Metadata = {"task": "franka", "seed": self.seed}
        with (
            simulated_setup(self.pace) as stage,
            PlannerProcess(partial(recording_planner, self.stopping)) as planning,
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
        self, stage: "SimulatedSetup", session: "Session", number: int
    ) -> "tuple[Trajectory, Trajectory, Trajectory]":
        """A run, how it really was, and as it was known while it went on."""
        from contactgraph.data import Metadata
        from contactgraph_franka.cli.options import RobotFault
        from contactgraph_franka.cli.session import episode_layout, episode_seed
        from contactgraph_franka.envs.expert import grasps
        from contactgraph_franka.sim.shared_state import ground_truth_trajectory

        for attempt in range(_AGAIN):
            # Where the arm hides the block for too long, it does so each time: another one then.
            draw = number + attempt * _MOST_RUNS
            seed = episode_seed(self.seed, draw)
            layout = episode_layout(self.seed, draw, stage.limits)
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

    from contactgraph_franka.envs.expert import RecordingPolicy
    from contactgraph_franka.envs.pickup import pickup_scene
    from contactgraph_franka.loop.planner import PolicyPlanner

    return PolicyPlanner(RecordingPolicy(stopping), pickup_scene(0.01, np.zeros(3)))
