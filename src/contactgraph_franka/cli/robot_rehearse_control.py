"""``contactgraph robot rehearse-control``: a rehearsal, and a learned model that controls in it."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from contactgraph.data import Trajectory
    from contactgraph_franka.cli.rehearsed_arm import RehearsedArm
    from contactgraph_franka.cli.robot_session import Session


@dataclass(frozen=True)
class RehearseControl:
    """Rehearse an arm that picks blocks up by MPC with a learned model, seen by its camera.

    Each episode has its own start, block and goal. It succeeded where, at its end and in truth, a
    finger touches the block within 0.05 m of the goal.
    """

    run_name: Positional[Annotated[str, arg(metavar="RUN")]]
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
        from contactgraph.cli.output import check_writable, progress, say, write_json
        from contactgraph.data import write_trajectories
        from contactgraph_franka.cli.rehearsed_arm import rehearsed_arm
        from contactgraph_franka.cli.robot_options import check_seconds
        from contactgraph_franka.cli.robot_planners import mpc_planner
        from contactgraph_franka.cli.robot_session import Session
        from contactgraph_franka.loop import PlanningProcess

        for path in (self.save, self.json):
            check_writable(path)
        check_range("--episodes", self.episodes, 1, 1000)
        check_range("--horizon", self.horizon, 1, 1000)
        check_seed(self.seed)
        check_seconds("--seconds", self.seconds, 25.0)
        model = model_path(self.run_name)
        found: list[dict[str, Any]] = []
        runs: list[Trajectory] = []
        with rehearsed_arm(self.pace) as stage:
            force = stage.limits.max_force
            make = partial(mpc_planner, model, force, self.horizon, self.infer_contacts)
            with PlanningProcess(make) as planning, progress("episodes", self.episodes) as steps:
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
        say(f"success {100 * summary['success_rate']:.0f} % ({100 * low:.0f} to {100 * high:.0f})")
        for each in found:
            if not each["success"]:
                say(f"  {each['number']}: {100 * each['distance_m']:.1f} cm; {each['end']}")

    def _episode(
        self, stage: "RehearsedArm", session: "Session", number: int
    ) -> "tuple[dict[str, Any], Trajectory | None]":
        """What is measured of an episode, and how it really was; None where nothing was sent."""
        import numpy as np

        from contactgraph_franka.cli.rehearsed_arm import run_layout, run_seed
        from contactgraph_franka.envs.pickup import GOAL_RADIUS, HAND, TARGET
        from contactgraph_franka.sim.shared_state import ground_truth_trajectory

        layout = run_layout(self.seed, number, stage.limits)
        stage.arrange(layout)
        report = session.run(layout.goal, run_seed(self.seed, number), lambda: False)
        run = session.recorded(layout.goal, {"number": number, "model": self.run_name})
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
            "run": self.run_name,
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
