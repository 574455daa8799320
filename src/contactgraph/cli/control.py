"""``contactgraph control``: a model in closed loop with a task."""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from contactgraph.cli.options import (
    Delay,
    Distractors,
    FalseAlarms,
    Grasp,
    Misses,
    ModelArgument,
    Objects,
    OutputFile,
    TaskArgument,
)

if TYPE_CHECKING:
    from contactgraph.evaluate import ClosedLoopMetrics, OpenLoopMetrics

_LEARNED_COST_HORIZON = 2
"""Factor of the default horizon with a learned cost. Such a cost does not demand the contacts that
its demonstrations made: a plan that ends before their benefit would hover before the object."""

_RECORDED = (
    *("cost", "horizon", "replan_every", "false_alarms", "misses", "delay", "unmeasured"),
    *("position_noise", "velocity_noise", "infer_contacts"),
)
"""Options that the JSON file repeats."""


@dataclass(frozen=True)
class Control:
    """Control a task through contact by iLQR-MPC with a learned model, episode after episode."""

    model: ModelArgument
    task: TaskArgument
    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Random seed; the same seed gives the same episodes."""
    distractors: Distractors = 0
    objects: Objects = None
    grasp: Grasp = None
    radius: Annotated[float | None, arg(metavar="M", help_behavior_hint="(pickup: 0.04)")] = None
    """Radius of every body of pickup, m."""
    cost: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(the task's cost)")] = None
    """Cost file by learn-cost, to plan with in place of the task's own cost."""
    horizon: Annotated[
        int | None, arg(metavar="INT", help_behavior_hint="(20; franka 50; twice with --cost)")
    ] = None
    """Planning horizon, steps."""
    replan_every: int = 1
    """Steps between plans; the plan's feedback acts in between."""
    deadline_ms: Annotated[float | None, arg(metavar="MS", help_behavior_hint="(optional)")] = None
    """Time limit of a plan, ms; the previous plan replaces a later one."""
    false_alarms: FalseAlarms = 0.0
    misses: Misses = 0.0
    delay: Delay = 0
    unmeasured: bool = False
    """Control without a contact sensor."""
    position_noise: Annotated[float, arg(metavar="M")] = 0.0
    """Standard deviation of the noise on every observed position, m."""
    velocity_noise: Annotated[float, arg(metavar="M/S")] = 0.0
    """Standard deviation of the noise on every observed velocity, m/s."""
    infer_contacts: bool = False
    """Also correct the contact beliefs by the observed motion."""
    json: OutputFile = None
    """Write the measurements to this file."""
    video: OutputFile = None
    """Write the first episode as an animation to this file (.gif, or .mp4 with ffmpeg)."""
    save: OutputFile = None
    """Write the episodes to this dataset file (HDF5)."""

    def run(self) -> None:
        """Run the episodes, write the files that are asked for, and print a summary."""
        from contactgraph.cli.models import stored_model
        from contactgraph.cli.options import check_episodes, check_range, check_seed, sensor_faults
        from contactgraph.cli.output import check_writable, progress, write_json
        from contactgraph.cli.task_types import TaskOptions
        from contactgraph.cli.tasks import known_task, task_factory
        from contactgraph.control import read_cost
        from contactgraph.data import (
            Dataset,
            InvalidInputError,
            Metadata,
            Trajectory,
            write_trajectories,
        )
        from contactgraph.evaluate import (
            EpisodeRecord,
            ObservationNoise,
            control_task,
            evaluate_open_loop,
        )
        from contactgraph.model import MotionNoise
        from contactgraph.viz import check_animation, scene_trajectory, write_animation

        for path in (self.json, self.video, self.save):
            check_writable(path)
        if self.video is not None:
            check_animation(self.video)
        check_episodes(self.episodes)
        check_seed(self.seed)
        horizon = known_task(self.task).horizon
        if self.cost is not None:
            horizon *= _LEARNED_COST_HORIZON
        if self.horizon is not None:
            check_range("--horizon", self.horizon, 1, 1000)
            horizon = self.horizon
        faults = sensor_faults(self.false_alarms, self.misses, self.delay, self.seed)
        if self.unmeasured and not faults.exact:
            raise InvalidInputError(
                "--unmeasured: no contact is measured, so --false-alarms, --misses and --delay "
                "must be left out"
            )
        noise = ObservationNoise(self.position_noise, self.velocity_noise, self.seed)
        motion_noise = MotionNoise(noise.position, noise.velocity) if self.infer_contacts else None
        options = TaskOptions(self.distractors, self.objects, self.grasp, radius=self.radius)
        factory = task_factory(self.task, options)
        cost = None if self.cost is None else read_cost(self.cost)
        model = stored_model(self.model)
        first: list[EpisodeRecord] = []
        finished = itertools.count(1)
        with progress("controlling", self.episodes) as bar:

            def on_episode(trajectory: Trajectory, record: EpisodeRecord) -> None:
                first[:] = first or [record]
                bar.advance(next(finished))

            metrics, trajectories = control_task(
                model,
                factory,
                self.episodes,
                self.seed,
                cost=cost,
                horizon=horizon,
                replan_every=self.replan_every,
                deadline=None if self.deadline_ms is None else self.deadline_ms / 1e3,
                faults=faults,
                measured=not self.unmeasured,
                noise=noise,
                motion_noise=motion_noise,
                on_episode=on_episode,
            )
        metadata: Metadata = {"task": self.task, "seed": self.seed, **options.metadata}
        dataset = Dataset(tuple(trajectories), metadata)
        predicted = evaluate_open_loop(model, dataset, faults=faults, motion_noise=motion_noise)
        values = {
            "run": self.model,
            **metadata,
            **{name: getattr(self, name) for name in _RECORDED},
            "cost": None if self.cost is None else str(self.cost),
            "horizon": horizon,
            **predicted.to_json(),
            **metrics.to_json(),
        }
        if self.save is not None:
            write_trajectories(self.save, trajectories, metadata)
        if self.video is not None:
            name = f"{self.task}, {self.distractors} distractors"
            scene = scene_trajectory(model, name, trajectories[0], first[0].plan)
            write_animation(self.video, scene)
        write_json(self.json, values)
        _print_summary(metrics, predicted)


def _print_summary(metrics: "ClosedLoopMetrics", predicted: "OpenLoopMetrics") -> None:
    low, high = metrics.success_interval
    speed, f1 = metrics.contact_speed_m_s, metrics.estimated.edges.f1
    planned = metrics.planned.planned.rmse
    print(
        f"success                    {100 * metrics.success_rate:.0f} % of "
        f"{metrics.episodes} episodes (95 %: {100 * low:.0f} to {100 * high:.0f})"
    )
    print(f"speed at contact, median   {'no contact' if speed is None else f'{speed:.2f} m/s'}")
    print(f"touched a distractor       {metrics.touched_bystanders} episodes")
    print(
        f"control step               {metrics.plan_ms_p50:.2f} ms median, "
        f"{metrics.plan_ms_p99:.2f} ms 99 %"
    )
    print(f"contact estimate, F1       {'no contact' if f1 is None else f'{f1:.4f}'}")
    print(f"predicted, over {predicted.n_steps} steps   {100 * predicted.n_step_rmse_m:.3f} cm")
    if planned is not None:
        print(f"planned, over {predicted.n_steps} steps     {100 * planned:.3f} cm")
