"""``contactgraph robot record`` and ``rehearse-record``: datasets from a real or simulated arm."""

import math
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from contactgraph.cli.options import check_range, check_seed
from contactgraph.cli.output import check_writable, progress, write_json
from contactgraph.data import (
    InvalidInputError,
    Metadata,
    Trajectory,
    read_trajectories,
    write_trajectories,
)
from contactgraph.envs.contract import Policy
from contactgraph_franka.cli.arms import Arm, open_arm
from contactgraph_franka.cli.options import ArmOptions, RobotFault, check_seconds, ctrl_c, point
from contactgraph_franka.cli.session import (
    Session,
    SimulatedSetup,
    count_down,
    episode_layout,
    episode_seed,
    simulated_setup,
    wait_for_block,
)
from contactgraph_franka.envs.expert import FrankaExpert, RecordingPolicy, grasps
from contactgraph_franka.envs.pickup import HAND, TARGET, ArmLayout, pickup_scene
from contactgraph_franka.loop import PlannerProcess
from contactgraph_franka.loop.planner import PolicyPlanner

_DT = 0.01
"""s, of a policy's steps."""
_SHORTEST_S = 1.0
"""s of recording before a stop that make a trajectory."""
_SHORTEST_SHARE = 0.5
"""The same of a simulated arm, as a share of the episode."""
_ATTEMPTS = 6
"""Layouts tried for one trajectory, where the control loop stops."""
_MAX_TRAJECTORIES = 1000
"""In a file."""


@dataclass(frozen=True)
class Record:
    """Record trajectories of the scripted expert on an arm, to train on; resumes after a stop.

    Each has its own start, goal and position of the block, by its number and the seed. A simulated
    robot puts the block there, else a person is asked to. Each is written as it ends.
    """

    address: Positional[Annotated[str, arg(metavar="ADDR")]]
    """The arm's address, a simulated robot's, or fake."""
    out: Annotated[Path, arg(metavar="FILE")]
    """The dataset file (HDF5); trajectories already in it count."""
    runs: int = 30
    """Number of trajectories in the file."""
    seconds: float = 10.0
    """Duration of each."""
    seed: int = 0
    """The same seed has the same starts, goals and noise."""
    noise: Annotated[float, arg(metavar="N")] = 0.5
    """Standard deviation of the force added on each axis, which makes masses identifiable."""
    arm: ArmOptions = field(default_factory=ArmOptions)

    def run(self) -> None:
        """Record and write."""
        check_writable(self.out)
        check_range("--runs", self.runs, 1, _MAX_TRAJECTORIES)
        check_seed(self.seed)
        check_seconds("--seconds", self.seconds)
        if not 0.0 <= self.noise < math.inf:
            raise InvalidInputError(f"--noise must be at least 0, found {self.noise}")
        limits = self.arm.limits(self.address)
        done = _existing(self.out, seed=self.seed, noise=self.noise)
        if len(done) >= self.runs:
            print(f"{self.out}: has its {len(done)} trajectories already")
            return
        metadata: Metadata = {"task": "franka", "seed": self.seed, "noise": self.noise}
        with (
            open_arm(self.address, self.arm) as arm,
            _planning(FrankaExpert(self.noise)) as planner,
            progress("recording", self.runs) as steps,
        ):
            session = Session(arm, limits, planner, self.seconds)
            for number in range(len(done), self.runs):
                layout = episode_layout(self.seed, number, limits)
                _arrange(arm, layout)
                with ctrl_c() as pressed:
                    report = session.run(layout.goal, episode_seed(self.seed, number), pressed)
                trajectory = session.trajectory(
                    layout.goal, {"number": number, "policy": "FrankaExpert", "seed": self.seed}
                )
                seconds = 0.0 if trajectory is None else trajectory.steps * trajectory.scene.dt
                if trajectory is not None and seconds >= _SHORTEST_S:
                    done.append(trajectory)
                    write_trajectories(self.out, done, metadata)
                if not report.completed:
                    reason = f"{report.stop.reason.value}. {arm.last_error()}".strip()
                    raise RobotFault(
                        f"episode {number} stopped: {reason} {self.out} has {len(done)} "
                        "trajectories; the same command continues from there"
                    )
                if pressed():
                    break
                success = session.outcome(layout.goal).success
                result = "held at the goal" if success else "not brought to the goal"
                steps.advance(number + 1, f"{result}, {report.rate_hz:.0f} Hz")
        print(f"{self.out}: {len(done)} trajectories of {self.runs}")
        if done:
            succeeded = sum(bool(each.scene.metadata.get("success")) for each in done)
            print(f"the expert succeeded in {succeeded} of {len(done)} trajectories")


def _planning(policy: Policy) -> PlannerProcess:
    scene = pickup_scene(_DT, np.zeros(3))  # each episode has its own goal
    return PlannerProcess(partial(PolicyPlanner, policy, scene))


def _existing(path: Path, **flags: float) -> list[Trajectory]:
    """The trajectories of an earlier call of the command, which must have had the same flags."""
    if not path.exists():
        return []
    dataset = read_trajectories(path)
    if any(dataset.metadata.get(name) != value for name, value in flags.items()):
        earlier = " ".join(f"--{name} {dataset.metadata.get(name)}" for name in flags)
        raise InvalidInputError(
            f"{path}: was recorded with {earlier}; use the same, or name another file"
        )
    return list(dataset)


def _arrange(arm: Arm, layout: ArmLayout) -> None:
    """Puts hand and block to the start of an episode."""
    count_down(arm, f"the hand opens and moves slowly to {point(layout.hand)} m")
    arm.move_to(layout.hand, layout.yaw)
    if not arm.place_block(layout):
        at = point(layout.blocks[0][:2])
        input(f"Put the block at {at} m, a side towards the hand; then Enter ")
    wait_for_block(arm)
    goal = point(layout.goal)
    count_down(arm, f"the hand will sweep through the block and bring it to {goal} m")


@dataclass(frozen=True)
class RecordSimulated:
    """Record trajectories of a simulated arm with a camera; resumes after a stop.

    In some the block is grasped, at rest or in passing, and carried from place to place, in others
    the hand moves beside it. Contacts are the simulation's, to score contacts estimated without a
    sensor; training reads none. Beside FILE.h5 it writes FILE.truth.h5, the same trajectories by
    the simulation's ground truth, and FILE.live.h5, as they were tracked online, without smoothing.
    """

    out: Annotated[Path, arg(metavar="FILE")]
    """The dataset file (HDF5); trajectories already in it count."""
    runs: int = 30
    """Number of trajectories in the file."""
    seconds: float = 10.0
    """Duration of each."""
    seed: int = 0
    """The same seed has the same starts, goals and noise."""
    pace: float = 4.0
    """Wall seconds to a simulated one."""
    stopping: float = 0.5
    """Share of grasps at rest; the others are in passing, as all of the paper's."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the tracking errors of the block, and the loop's rates, to this file."""

    def run(self) -> None:
        """Record and write."""
        for path in (self.out, self.json):
            check_writable(path)
        check_range("--runs", self.runs, 1, _MAX_TRAJECTORIES)
        check_seed(self.seed)
        check_seconds("--seconds", self.seconds, 25.0)
        check_range("--stopping", self.stopping, 0, 1)
        paths = [self.out, *(self.out.with_suffix(f".{name}.h5") for name in ("truth", "live"))]
        kept = [_existing(path, seed=self.seed) for path in paths]
        # A process that was killed between two files has left one more in the first of them.
        count = min(map(len, kept))
        kept = [trajectories[:count] for trajectories in kept]
        if count < self.runs:
            self._record(paths, kept)
        values = _summary(kept[0], kept[1])
        write_json(self.json, {"data": str(self.out), "seed": self.seed, **values})
        print(
            f"{self.out}: {values['runs']} trajectories, {values['completed']} of them to their "
            f"end; the block is off by {1e3 * values['position_error_m']:.2f} mm (median), "
            f"{1e3 * values['position_error_worst_m']:.1f} mm (worst)"
        )

    def _record(self, paths: list[Path], kept: list[list[Trajectory]]) -> None:
        """Records the missing trajectories, and writes each as it ends."""
        metadata: Metadata = {"task": "franka", "seed": self.seed}
        with (
            simulated_setup(self.pace) as setup,
            _planning(RecordingPolicy(self.stopping)) as planner,
            progress("recording", self.runs) as steps,
        ):
            session = Session(setup.arm, setup.limits, planner, self.seconds)
            for number in range(len(kept[0]), self.runs):
                recorded = self._episode(setup, session, number)
                for path, trajectories, new in zip(paths, kept, recorded, strict=True):
                    trajectories.append(new)
                    write_trajectories(path, trajectories, metadata)
                steps.advance(number + 1, f"{recorded[0].steps} steps")

    def _episode(
        self, setup: SimulatedSetup, session: Session, number: int
    ) -> tuple[Trajectory, Trajectory, Trajectory]:
        """One trajectory: smoothed, by the ground truth, and as tracked online."""
        from contactgraph_franka.sim.shared_state import ground_truth_trajectory

        for attempt in range(_ATTEMPTS):
            # A layout in which the arm hides the block for too long fails again: another is drawn.
            draw = number + attempt * _MAX_TRAJECTORIES
            seed = episode_seed(self.seed, draw)
            layout = episode_layout(self.seed, draw, setup.limits)
            setup.arrange(layout)
            report = session.run(layout.goal, seed)
            metadata: Metadata = {
                "number": number,
                "policy": "FrankaRecording",
                "grasp": grasps(seed),
                "attempt": attempt,
                "completed": report.completed,
                "end": report.stop.reason.value,
                "rate_hz": report.rate_hz,
            }
            smooth = session.trajectory(layout.goal, metadata)
            live = session.trajectory(layout.goal, metadata, smooth=False)
            if smooth is None or live is None:
                continue
            if smooth.steps >= _SHORTEST_SHARE * self.seconds / smooth.scene.dt:
                truth = ground_truth_trajectory(
                    setup.simulation.ground_truth, smooth, session.began
                )
                smooth, live = (replace(each, contact=truth.contact) for each in (smooth, live))
                return smooth, truth, live
        raise RobotFault(
            f"episode {number} stopped {_ATTEMPTS} times, at last: {report.stop.reason.value}"
        )


def _summary(recorded: list[Trajectory], truth: list[Trajectory]) -> dict[str, Any]:
    """Tracking errors and loop rates of all trajectories together."""
    error = np.concatenate(
        [
            np.linalg.norm(each.position - true.position, axis=2)
            for each, true in zip(recorded, truth, strict=True)
        ]
    )
    metadata = [each.scene.metadata for each in recorded]
    return {
        "runs": len(recorded),
        "steps": sum(each.steps for each in recorded),
        "completed": sum(bool(one["completed"]) for one in metadata),
        "with_grasp": sum(bool(one["grasp"]) for one in metadata),
        "held_at_some_time": sum(
            bool(true.contact[:, HAND, TARGET].any()) for true in truth if true.contact is not None
        ),
        "pace": [float(one["pace"]) for one in metadata],
        "rate_hz": min(float(one["rate_hz"]) for one in metadata),
        "position_error_m": float(np.median(error[:, TARGET])),
        "position_error_p95_m": float(np.percentile(error[:, TARGET], 95.0)),
        "position_error_worst_m": float(error[:, TARGET].max()),
        "hand_error_worst_m": float(error[:, HAND].max()),
        "each": metadata,
    }
