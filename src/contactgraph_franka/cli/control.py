"""``contactgraph robot run``: a model controls an arm."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from contactgraph_franka.cli.options import ArmOptions
from contactgraph_franka.loop import Planner

if TYPE_CHECKING:
    import numpy as np

    from contactgraph_franka.cli.arms import Arm
    from contactgraph_franka.safety import SafetyLimits


@dataclass(frozen=True)
class Run:
    """Let an arm pick up a block and bring it to a goal, by MPC with a learned model."""

    model: Positional[Annotated[str, arg(metavar="MODEL")]]
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
        from contactgraph.cli.output import check_writable, write_json
        from contactgraph.data import write_trajectories
        from contactgraph_franka.cli.arms import open_arm
        from contactgraph_franka.cli.control import mpc_planner
        from contactgraph_franka.cli.options import (
            RobotFault,
            check_seconds,
            count_down,
            ctrl_c,
            place,
            wait_for_block,
        )
        from contactgraph_franka.cli.session import Session
        from contactgraph_franka.loop import PlannerProcess

        for path in (self.save, self.json):
            check_writable(path)
        check_seconds("--seconds", self.seconds)
        check_range("--horizon", self.horizon, 1, 1000)
        limits = self.arm.limits(self.address)
        goal = place("--goal", self.goal, limits)
        make = partial(
            mpc_planner,
            model_path(self.model),
            limits.max_force,
            self.horizon,
            self.infer_contacts,
        )
        with open_arm(self.address, self.arm) as arm:
            wait_for_block(arm)
            with PlannerProcess(make) as planning:
                session = Session(arm, limits, planning, self.seconds, self.dry_run)
                if not (self.dry_run or self.stay):
                    self._move_to_start(arm, goal, limits)
                count_down(arm, self._words(goal))
                with ctrl_c() as pressed:
                    report = session.run(goal, 0, pressed)
                said = "" if report.completed else arm.said()
            run = session.recorded(goal, {"model": self.model, "address": self.address})
        if run is not None and self.save is not None:
            write_trajectories(self.save, [run], {"task": "franka"})
        for line in report.lines():
            print(line)
        ended = session.ended(goal)
        write_json(
            self.json,
            {
                "run": self.model,
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
            print(ended.words)

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

        from contactgraph_franka.cli.options import RobotFault, count_down
        from contactgraph_franka.cli.session import seen_block
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


if TYPE_CHECKING:
    from contactgraph.data import Trajectory
    from contactgraph_franka.cli.session import Session, SimulatedSetup


@dataclass(frozen=True)
class RehearseControl:
    """Rehearse an arm that picks blocks up by MPC with a learned model, seen by its camera.

    Each episode has its own start, block and goal. It succeeded where, at its end and in truth, a
    finger touches the block within 0.05 m of the goal.
    """

    model: Positional[Annotated[str, arg(metavar="MODEL")]]
    """A run folder, a model file, or a model that ships with the package (franka)."""
    episodes: int = 20
    """How many."""
    seed: int = 0
    """The same seed has the same starts, blocks and goals."""
    seconds: float = 5.0
    """For how long each goes on."""
    pace: float = 4.0
    """Wall seconds to a simulated one."""
    horizon: Annotated[int, arg(metavar="INT")] = 100
    """Steps to plan ahead."""
    infer_contacts: bool = False
    """Find contacts by how things move, besides what the fingers tell."""
    save: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the runs, as they really were, to this dataset file (HDF5)."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the measurements to this file."""

    def run(self) -> None:
        """Control, and say how it went."""
        from contactgraph.cli.models import model_path
        from contactgraph.cli.options import check_range, check_seed
        from contactgraph.cli.output import check_writable, progress, write_json
        from contactgraph.data import write_trajectories
        from contactgraph_franka.cli.control import mpc_planner
        from contactgraph_franka.cli.options import check_seconds
        from contactgraph_franka.cli.session import Session, simulated_setup
        from contactgraph_franka.loop import PlannerProcess

        for path in (self.save, self.json):
            check_writable(path)
        check_range("--episodes", self.episodes, 1, 1000)
        check_range("--horizon", self.horizon, 1, 1000)
        check_seed(self.seed)
        check_seconds("--seconds", self.seconds, 25.0)
        model = model_path(self.model)
        found: list[dict[str, Any]] = []
        runs: list[Trajectory] = []
        with simulated_setup(self.pace) as stage:
            force = stage.limits.max_force
            make = partial(mpc_planner, model, force, self.horizon, self.infer_contacts)
            with PlannerProcess(make) as planning, progress("episodes", self.episodes) as steps:
                session = Session(stage.arm, stage.limits, planning, self.seconds)
                for number in range(self.episodes):
                    values, run = self._episode(stage, session, number)
                    found.append(values)
                    runs.extend([] if run is None else [run])
                    steps.advance(number + 1, f"{sum(each['success'] for each in found)} succeed")
            server = stage.rehearsal.report()
        if runs and self.save is not None:
            write_trajectories(self.save, runs, {"task": "franka", "seed": self.seed})
        summary = self._summary(found)
        write_json(self.json, {**summary, "server_ticks_per_wall_s": server.rate, "each": found})
        low, high = summary["success_interval"]
        rate = summary["success_rate"]
        print(f"success {100 * rate:.0f} % ({100 * low:.0f} to {100 * high:.0f})")
        for each in found:
            if not each["success"]:
                print(f"  {each['number']}: {100 * each['distance_m']:.1f} cm; {each['end']}")

    def _episode(
        self, stage: "SimulatedSetup", session: "Session", number: int
    ) -> "tuple[dict[str, Any], Trajectory | None]":
        """What is measured of an episode, and how it really was; None where nothing was sent."""
        import numpy as np

        from contactgraph_franka.cli.session import episode_layout, episode_seed
        from contactgraph_franka.envs.pickup import GOAL_RADIUS, HAND, TARGET
        from contactgraph_franka.sim.shared_state import ground_truth_trajectory

        layout = episode_layout(self.seed, number, stage.limits)
        stage.arrange(layout)
        report = session.run(layout.goal, episode_seed(self.seed, number), lambda: False)
        run = session.recorded(layout.goal, {"number": number, "model": self.model})
        last = stage.rehearsal.ground_truth.newest()
        distance = float(np.linalg.norm(last["position"][TARGET] - layout.goal))
        held = bool(last["fingers"][TARGET - 1].any())
        truth = (
            None
            if run is None
            else ground_truth_trajectory(stage.rehearsal.ground_truth, run, session.began)
        )
        speed = error = None
        if run is not None and truth is not None and truth.contact is not None:
            touched = np.flatnonzero(truth.contact[:, HAND, TARGET])
            if len(touched):
                speed = float(np.linalg.norm(truth.velocity[touched[0], HAND]))
            error = float(
                np.median(np.linalg.norm((run.position - truth.position)[:, TARGET], axis=1))
            )
        return {
            "number": number,
            "success": held and distance <= GOAL_RADIUS,
            "distance_m": distance,
            "held": held,
            "contact_speed_m_s": speed,
            "tracking_error_m": error,
            "end": report.stop.reason.value,
            "completed": report.completed,
            "rate_hz": report.rate_hz,
            "jitter_ms_p99": report.jitter_ms_p99,
            "plan_ms_p50": report.plan_ms_p50,
            "plan_ms_p99": report.plan_ms_p99,
            "plans": report.plans,
            "plans_late": report.plans_late,
        }, truth

    def _summary(self, found: list[dict[str, Any]]) -> dict[str, Any]:
        from statistics import median

        from contactgraph.evaluate import wilson_interval

        successes = sum(each["success"] for each in found)
        speeds = [one for each in found if (one := each["contact_speed_m_s"]) is not None]
        return {
            "run": self.model,
            "seed": self.seed,
            "episodes": self.episodes,
            "seconds": self.seconds,
            "pace": self.pace,
            "infer_contacts": self.infer_contacts,
            "successes": successes,
            "success_rate": successes / len(found),
            "success_interval": list(wilson_interval(successes, len(found))),
            "contact_speed_m_s": median(speeds) if speeds else None,
            "rate_hz": min(each["rate_hz"] for each in found),
        }


_NOWHERE = np.zeros(3)
"""m: each run has its own goal."""
_CONTROL_WEIGHT = 0.03
"""1/N^2. With the simulated task's 0.01, plans that far ahead begin with more force than an arm's
limits let pass, more along one axis than along another: the hand comes to the block on a bow."""


def mpc_planner(path: Path, max_force: float, horizon: int, infer_contacts: bool) -> Planner:
    """MPC with the model in the file ``path``, for the arm's pickup; forces up to ``max_force`` N.

    Raises `InvalidInputError` where there is no such model, or it is for something else.
    """
    from contactgraph.data import InvalidInputError
    from contactgraph.evaluate.mpc_policy import TaskCost
    from contactgraph.model import ContactDynamics, MotionNoise
    from contactgraph.model.io import load_model
    from contactgraph_franka.envs.pickup import pickup_cost, pickup_scene
    from contactgraph_franka.loop.mpc_planner import MPCPlanner

    model = load_model(path).model
    if not isinstance(model, ContactDynamics):
        raise InvalidInputError(f"{path}: must be a model of contacts to control an arm with")
    return MPCPlanner(
        model,
        pickup_scene(model.dt, _NOWHERE),
        TaskCost.of(replace(pickup_cost(), control_weight=_CONTROL_WEIGHT), len(_NOWHERE)),
        max_force,
        horizon=horizon,
        motion_noise=MotionNoise() if infer_contacts else None,
    )


def expert_planner(noise: float) -> Planner:
    """The scripted expert of the arm's pickup, with ``noise`` N on its force."""
    from contactgraph_franka.envs.expert import FrankaExpert
    from contactgraph_franka.envs.pickup import pickup_scene
    from contactgraph_franka.loop.planner import PolicyPlanner

    return PolicyPlanner(FrankaExpert(noise=noise), pickup_scene(0.01, _NOWHERE))
