"""``contactgraph robot run`` and ``rehearse-control``: MPC of a real or simulated arm."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from contactgraph.cli.options import (
    ModelArgument,
    PlannerName,
    check_range,
    check_seed,
    load_object,
)
from contactgraph.cli.output import check_writable, progress, write_json
from contactgraph.data import Trajectory, write_trajectories
from contactgraph_franka.cli.arms import Arm, open_arm
from contactgraph_franka.cli.options import (
    ArmOptions,
    RobotFault,
    check_position,
    check_seconds,
    ctrl_c,
    point,
)
from contactgraph_franka.cli.session import (
    Session,
    SimulatedSetup,
    block_position,
    count_down,
    episode_layout,
    episode_seed,
    simulated_setup,
    wait_for_block,
)
from contactgraph_franka.envs import pickup
from contactgraph_franka.loop import Planner, PlannerProcess
from contactgraph_franka.safety import SafetyLimits

_CONTROL_WEIGHT = 0.03
"""1/N^2. With the simulated task's 0.01, long plans begin with more force than an arm's limits
permit, more along one axis than along another, so that the hand approaches on a curve."""

_REPORTED = ("rate_hz", "jitter_ms_p99", "plan_ms_p50", "plan_ms_p99", "plans", "plans_late")
"""Numbers of the loop of an episode in the JSON of `ControlSimulated`."""


@dataclass(frozen=True)
class PlanOptions:
    """How plans are made."""

    horizon: Annotated[int, arg(metavar="INT")] = 100
    """Steps to plan ahead."""
    planner: PlannerName = None
    infer_contacts: bool = False
    """Infer contacts from motion, besides the fingers' sensor."""

    def check(self, model: str) -> None:
        """Refuses wrong names before the planner's process starts."""
        from contactgraph.cli.models import model_path

        check_range("--horizon", self.horizon, 1, 1000)
        model_path(model)
        if self.planner is not None:
            load_object("--planner", self.planner)


@dataclass(frozen=True)
class Run:
    """Let an arm pick up a block and bring it to a goal, by MPC with a learned model."""

    model: ModelArgument
    address: Positional[Annotated[str, arg(metavar="ADDR")]]
    """The arm's address, a simulated robot's, or fake."""
    goal: Annotated[tuple[float, ...], arg(metavar="X Y Z")]
    """Goal of the block, m, in the frame of the arm's base."""
    arm: ArmOptions = field(default_factory=ArmOptions)
    seconds: float = 5.0
    """Duration."""
    plans: PlanOptions = field(default_factory=PlanOptions)
    stay: bool = False
    """Begin at the hand's present position, without moving slowly to the start of a sweep first."""
    dry_run: bool = False
    """Read, plan and print the plans; the arm receives no command."""
    save: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the trajectory to this dataset file (HDF5), in steps of 0.001 s."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the measurements to this file."""

    def run(self) -> None:
        """Control the arm, and print the result."""
        for path in (self.save, self.json):
            check_writable(path)
        check_seconds("--seconds", self.seconds)
        limits = self.arm.limits(self.address)
        goal = check_position("--goal", self.goal, limits)
        self.plans.check(self.model)
        make = partial(mpc_planner, self.model, limits.max_force, self.plans)
        with open_arm(self.address, self.arm) as arm:
            wait_for_block(arm)
            with PlannerProcess(make) as planner:
                session = Session(arm, limits, planner, self.seconds, self.dry_run)
                if not (self.dry_run or self.stay):
                    _move_to_start(arm, goal, limits)
                count_down(arm, self._announcement(goal))
                with ctrl_c() as pressed:
                    report = session.run(goal, 0, pressed)
                error = "" if report.completed else arm.last_error()
            trajectory = session.trajectory(goal, {"model": self.model, "address": self.address})
        if trajectory is not None and self.save is not None:
            write_trajectories(self.save, [trajectory], {"task": "franka"})
        for line in report.lines():
            print(line)
        outcome = session.outcome(goal)
        write_json(
            self.json,
            {
                "run": self.model,
                "address": self.address,
                "goal": goal.tolist(),
                "dry_run": self.dry_run,
                "pace": arm.clock.pace,
                **vars(outcome),
                **report.to_json(),
            },
        )
        if not report.completed:
            raise RobotFault(f"the arm stopped: {report.stop.reason.value}. {error}".strip())
        if not self.dry_run:
            print(outcome)

    def _announcement(self, goal: np.ndarray) -> str:
        at = ", ".join(f"{number:g}" for number in goal)
        if self.dry_run:
            return f"plans to bring the block to ({at}) m are made and printed; nothing is sent"
        return (
            f"the hand will sweep through the block and bring it to ({at}) m within "
            f"{self.seconds:g} s, with at most {self.arm.max_force:g} N"
        )


def _move_to_start(arm: Arm, goal: np.ndarray, limits: SafetyLimits) -> None:
    """Moves the hand slowly to the start of a sweep through the block."""
    block = block_position(arm)
    low, high = np.array(limits.workspace_low), np.array(limits.workspace_high)
    hand = pickup.sweep_start(block, arm.block_yaw, goal, low, high)
    at = point(block, 3)
    if hand is None:
        raise RobotFault(
            f"the block at {at} m cannot be swept through within the workspace: put it "
            "nearer to the middle, or use --stay"
        )
    count_down(arm, f"the block is at {at} m; the hand first moves slowly to {point(hand)} m")
    arm.move_to(hand, pickup.sweep_yaw(hand, block))


@dataclass(frozen=True)
class ControlSimulated:
    """Let a simulated arm with a camera pick up blocks, by MPC with a learned model.

    Each episode has its own start, block and goal. It succeeds if at its end, by the ground truth,
    a finger touches the block within 0.05 m of the goal.
    """

    model: ModelArgument
    episodes: int = 20
    """Number of episodes."""
    seed: int = 0
    """The same seed has the same starts, blocks and goals."""
    seconds: float = 5.0
    """Duration of each."""
    pace: float = 4.0
    """Wall seconds to a simulated one."""
    plans: PlanOptions = field(default_factory=PlanOptions)
    save: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the ground-truth trajectories to this dataset file (HDF5)."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the measurements to this file."""

    def run(self) -> None:
        """Run the episodes, and print the success rate."""
        from contactgraph.evaluate import wilson_interval

        for path in (self.save, self.json):
            check_writable(path)
        check_range("--episodes", self.episodes, 1, 1000)
        check_seed(self.seed)
        check_seconds("--seconds", self.seconds, 25.0)
        self.plans.check(self.model)
        results: list[dict[str, Any]] = []
        trajectories: list[Trajectory] = []
        with simulated_setup(self.pace) as setup:
            make = partial(mpc_planner, self.model, setup.limits.max_force, self.plans)
            with PlannerProcess(make) as planner, progress("episodes", self.episodes) as steps:
                session = Session(setup.arm, setup.limits, planner, self.seconds)
                for number in range(self.episodes):
                    result, truth = self._episode(setup, session, number)
                    results.append(result)
                    trajectories.extend([] if truth is None else [truth])
                    steps.advance(number + 1, f"{sum(one['success'] for one in results)} succeed")
            steps_per_s = setup.simulation.rate
        if trajectories and self.save is not None:
            write_trajectories(self.save, trajectories, {"task": "franka", "seed": self.seed})
        successes = sum(one["success"] for one in results)
        speeds = [speed for one in results if (speed := one["contact_speed_m_s"]) is not None]
        rate, (low, high) = successes / len(results), wilson_interval(successes, len(results))
        summary = {
            "run": self.model,
            **{name: getattr(self, name) for name in ("seed", "episodes", "seconds", "pace")},
            "infer_contacts": self.plans.infer_contacts,
            "successes": successes,
            "success_rate": rate,
            "success_interval": [low, high],
            "contact_speed_m_s": median(speeds) if speeds else None,
            "rate_hz": min(one["rate_hz"] for one in results),
        }
        write_json(self.json, {**summary, "server_ticks_per_wall_s": steps_per_s, "each": results})
        print(f"success {100 * rate:.0f} % ({100 * low:.0f} to {100 * high:.0f})")
        for one in [each for each in results if not each["success"]]:
            print(f"  {one['number']}: {100 * one['distance_m']:.1f} cm; {one['end']}")

    def _episode(
        self, setup: SimulatedSetup, session: Session, number: int
    ) -> tuple[dict[str, Any], Trajectory | None]:
        """Measurements and ground truth of an episode; the latter None where no force was sent."""
        from contactgraph_franka.sim.shared_state import ground_truth_trajectory

        layout = episode_layout(self.seed, number, setup.limits)
        setup.arrange(layout)
        report = session.run(layout.goal, episode_seed(self.seed, number))
        recorded = session.trajectory(layout.goal, {"number": number, "model": self.model})
        ground_truth = setup.simulation.ground_truth
        last = ground_truth.newest()
        distance = float(np.linalg.norm(last["position"][pickup.TARGET] - layout.goal))
        held = bool(last["fingers"][pickup.TARGET - 1].any())
        truth = speed = error = None
        if recorded is not None:
            truth = ground_truth_trajectory(ground_truth, recorded, session.began)
        if recorded is not None and truth is not None and truth.contact is not None:
            touched = np.flatnonzero(truth.contact[:, pickup.HAND, pickup.TARGET])
            if len(touched):
                speed = float(np.linalg.norm(truth.velocity[touched[0], pickup.HAND]))
            offset = (recorded.position - truth.position)[:, pickup.TARGET]
            error = float(np.median(np.linalg.norm(offset, axis=1)))
        return {
            "number": number,
            "success": held and distance <= pickup.GOAL_RADIUS,
            "distance_m": distance,
            "held": held,
            "contact_speed_m_s": speed,
            "tracking_error_m": error,
            "end": report.stop.reason.value,
            "completed": report.completed,
            **{name: getattr(report, name) for name in _REPORTED},
        }, truth


def mpc_planner(name: str, max_force: float, options: PlanOptions) -> Planner:
    """MPC with the model ``name``, for the arm's pickup; forces up to ``max_force`` N.

    Raises `InvalidInputError` as `stored_model` does, and for a model of another task.
    """
    from contactgraph.cli.models import stored_model
    from contactgraph.control import compile_small_loops
    from contactgraph.model import motion_noise
    from contactgraph.policies.task_cost import TaskCost
    from contactgraph_franka.loop.mpc_planner import MPCPlanner

    compile_small_loops()
    model = stored_model(name)
    return MPCPlanner(
        model,
        pickup.pickup_scene(model.dt, np.zeros(3)),  # each episode has its own goal
        TaskCost(replace(pickup.pickup_cost(), control_weight=_CONTROL_WEIGHT), 3),
        max_force,
        horizon=options.horizon,
        planner=None if options.planner is None else load_object("--planner", options.planner),
        motion_noise=motion_noise(model) if options.infer_contacts else None,
    )
