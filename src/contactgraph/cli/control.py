"""``contactgraph control``: a model in closed loop with a task."""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

_FARTHER = 2
"""With a learned cost plans look so many times as far ahead. A cost is learned along contacts that
were made, so nothing in it says that they must be: who does not look beyond a contact may find that
it does not pay, and hover before it."""


@dataclass(frozen=True)
class Control:
    """Control a task through contact by iLQR-MPC with a learned model, episode after episode."""

    model: Positional[Annotated[str, arg(metavar="MODEL")]]
    """A run folder, a model file, or a model that ships with the package (pickup)."""
    task: Positional[Annotated[str, arg(metavar="TASK")]]
    """The task: pickup, multi-pickup, door or franka (an arm; needs the extra mujoco)."""
    episodes: int = 100
    """How many episodes."""
    seed: int = 0
    """The same seed gives the same episodes."""
    distractors: int = 0
    """Bystanders: objects, 0 to 20, doors, 0 to 10, or blocks, 0 to 5."""
    objects: Annotated[int | None, arg(metavar="INT")] = None
    """Objects to pick up, 1 to 5, where the task has a choice (multi-pickup: 2)."""
    grasp: Annotated[str | None, arg(metavar="HOW")] = None
    """How fingers hold, where the task has some: friction or weld."""
    radius: Annotated[float | None, arg(metavar="M")] = None
    """Of every body of pickup, m, in place of the 0.04 m that its models are trained with."""
    cost: Annotated[Path | None, arg(metavar="FILE")] = None
    """Plan with the cost in this file, as learn-cost writes it, in place of the task's own."""
    horizon: Annotated[int | None, arg(metavar="INT")] = None
    """Steps to plan ahead; 20, for franka 50, with --cost twice that, if not given."""
    replan_every: int = 1
    """Steps between plans; feedback acts in between."""
    deadline_ms: Annotated[float | None, arg(metavar="MS")] = None
    """A plan that takes longer, in ms, is not used; the last one is."""
    false_alarms: Annotated[float, arg(metavar="RATE")] = 0.0
    """Share of free edges that a lying sensor reports as touching, at every step."""
    misses: Annotated[float, arg(metavar="RATE")] = 0.0
    """Share of touching edges that it reports as free."""
    delay: Annotated[int, arg(metavar="STEPS")] = 0
    """Steps by which the sensor is late."""
    unmeasured: bool = False
    """Keep all measured contacts from the controller."""
    position_noise: Annotated[float, arg(metavar="M")] = 0.0
    """Noise on every position that the controller observes: standard deviation, m."""
    velocity_noise: Annotated[float, arg(metavar="M/S")] = 0.0
    """The same on velocities, m/s."""
    infer_contacts: bool = False
    """Correct beliefs by how things are seen to move, too: contact without a sensor."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the measurements to this file."""
    video: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the first episode as an animation to this file (.gif, or .mp4 with ffmpeg)."""
    save: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the episodes to this dataset file (HDF5)."""

    def run(self) -> None:
        """Run the episodes and say how they went."""
        from contactgraph.cli.models import model_path
        from contactgraph.cli.options import check_episodes, check_range, check_seed, sensor_faults
        from contactgraph.cli.output import check_writable, progress, write_json
        from contactgraph.cli.tasks import TaskOptions, known_task, task_factory
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
        from contactgraph.model.io import load_model
        from contactgraph.viz import scene_run
        from contactgraph.viz.animation import check_animation, write_animation

        for path in (self.json, self.video, self.save):
            check_writable(path)
        if self.video is not None:
            check_animation(self.video)
        check_episodes(self.episodes)
        check_seed(self.seed)
        horizon = known_task(self.task).horizon
        if self.cost is not None:
            horizon *= _FARTHER
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
        motion_noise = None
        if self.infer_contacts:
            motion_noise = MotionNoise(noise.position, noise.velocity)
        options = TaskOptions(self.distractors, self.objects, self.grasp, radius=self.radius)
        factory = task_factory(self.task, options)
        cost = None if self.cost is None else read_cost(self.cost)
        model = load_model(model_path(self.model)).model
        first: list[EpisodeRecord] = []
        done = itertools.count(1)

        with progress("controlling", self.episodes) as steps:

            def on_episode(run: Trajectory, record: EpisodeRecord) -> None:
                if not first:
                    first.append(record)
                steps.advance(next(done))

            metrics, runs = control_task(
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
        told: Metadata = {"task": self.task, "seed": self.seed, **options.metadata}
        dataset = Dataset(tuple(runs), told)
        predicted = evaluate_open_loop(model, dataset, faults=faults, motion_noise=motion_noise)
        values = {
            "run": self.model,
            **told,
            "cost": None if self.cost is None else str(self.cost),
            "horizon": horizon,
            "replan_every": self.replan_every,
            "false_alarms": self.false_alarms,
            "misses": self.misses,
            "delay": self.delay,
            "unmeasured": self.unmeasured,
            "position_noise": self.position_noise,
            "velocity_noise": self.velocity_noise,
            "infer_contacts": self.infer_contacts,
            **predicted.to_json(),
            **metrics.to_json(),
        }
        if self.save is not None:
            write_trajectories(self.save, runs, dataset.metadata)
        if self.video is not None:
            name = f"{self.task}, {self.distractors} distractors"
            write_animation(self.video, scene_run(model, name, runs[0], first[0].plan))
        write_json(self.json, values)
        low, high = metrics.success_interval
        print(
            f"success                    {100 * metrics.success_rate:.0f} % of "
            f"{metrics.episodes} episodes (95 %: {100 * low:.0f} to {100 * high:.0f})"
        )
        speed = metrics.contact_speed_m_s
        print(f"speed at contact, median   {'no contact' if speed is None else f'{speed:.2f} m/s'}")
        print(f"touched a bystander        {metrics.touched_bystanders} episodes")
        print(
            f"control tick               {metrics.plan_ms_p50:.2f} ms median, "
            f"{metrics.plan_ms_p99:.2f} ms 99 %"
        )
        f1 = metrics.found.edges.f1
        print(f"contacts known, F1          {'no contact' if f1 is None else f'{f1:.4f}'}")
        error = f"{100 * predicted.n_step_rmse_m:.3f} cm"
        print(f"predicted, over {predicted.n_steps} steps   {error}")
        planned = metrics.planned.planned.rmse
        if planned is not None:
            print(f"planned, over {predicted.n_steps} steps     {100 * planned:.3f} cm")
