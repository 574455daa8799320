"""``contactgraph control``: a model, or a scripted policy, in closed loop with a task."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from contactgraph.cli.options import (
    AUTO,
    Clearance,
    ControllerArgument,
    Delay,
    Device,
    Distractors,
    Engine,
    FalseAlarms,
    Grasp,
    HiddenSwitch,
    Horizon,
    Inference,
    Misses,
    Objects,
    OutputFile,
    Routes,
    Segment,
    Starts,
    TaskArgument,
)

if TYPE_CHECKING:
    from contactgraph.data import Trajectory
    from contactgraph.evaluate import ClosedLoopMetrics, EpisodeRecord
    from contactgraph.viz import SceneTrajectory

_HORIZON_WITHOUT_CONTACTS = 2
"""Factor of the default horizon with a learned cost that does not demand the contacts that its
demonstrations made: a plan that ends before their benefit would hover before the object."""

_RECORDED = (
    *("cost", "horizon", "iterations", "starts", "routes", "segment", "clearance", "replan_every"),
    *("false_alarms", "misses", "delay", "unmeasured"),
    *("position_noise", "velocity_noise", "infer_contacts", "inference"),
)
"""Options that only a model takes; the JSON file repeats them."""
_ROUTES = 7
"""With a clearance: with the running plan they fill a vector of eight."""
_SCRIPTED = ("expert", "fixed-start")
"""Names in place of a MODEL; a file or folder of such a name is given as a path, ``./expert``."""
_PREDICTED_S = 0.5
"""Length of the predictions of executed episodes."""


@dataclass(frozen=True)
class _Controlled:
    """The episodes of a controller, and their numbers by JSON key."""

    trajectories: "Sequence[Trajectory]"
    metrics: "ClosedLoopMetrics"
    settings: Mapping[str, Any]
    predicted: Mapping[str, Any]
    """Predictions of the episodes."""
    measured: Mapping[str, Any]
    scene: "Callable[[str], SceneTrajectory]"
    """The first episode, to be drawn under a name."""


@dataclass(frozen=True)
class Control:
    """Control a task through contact by iLQR-MPC with a learned model, episode after episode.

    A scripted policy in the model's place (expert, fixed-start) is the baseline in the same scenes.
    """

    model: ControllerArgument
    task: TaskArgument
    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Random seed; the same seed gives the same episodes."""
    distractors: Distractors = 0
    objects: Objects = None
    grasp: Grasp = None
    hidden_switch: HiddenSwitch = False
    engine: Engine = None
    radius: Annotated[float | None, arg(metavar="M", help_behavior_hint="(pickup: 0.04)")] = None
    """Radius of every body of pickup, m."""
    in_the_way: bool = False
    """pickup: a straight way to the target and the goal touches two distractors or more."""
    clearance: Clearance = None
    cost: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(the task's cost)")] = None
    """Cost file by learn-cost, to plan with in place of the task's own cost."""
    horizon: Horizon = None
    iterations: int = 5
    """Rollouts of iLQR a plan, at most."""
    starts: Starts = None
    routes: Routes = None
    segment: Segment = 0
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
    """Correct the contact beliefs by the observed motion, too. This is the default."""
    ignore_motion: bool = False
    """Correct the contact beliefs by measured contacts alone."""
    inference: Inference = "filter"
    json: OutputFile = None
    """Write the measurements to this file."""
    video: OutputFile = None
    """Write the first episode as an animation to this file (.gif, or .mp4 with ffmpeg)."""
    save: OutputFile = None
    """Write the episodes to this dataset file (HDF5)."""
    device: Device = AUTO

    def run(self) -> "Callable[[str], SceneTrajectory]":
        """Run the episodes, write the files that are asked for, and print a summary.

        Returns a function that gives the first episode, with its plans, a name to draw it under.
        """
        from contactgraph.cli.control_output import not_predicted
        from contactgraph.cli.known_tasks import HIDDEN_HOLD_STARTS
        from contactgraph.cli.models import (
            data_simulator,
            motion_evidence,
            stored_model,
            with_inference,
        )
        from contactgraph.cli.options import check_episodes, check_range, check_seed, sensor_faults
        from contactgraph.cli.output import check_writable, progress
        from contactgraph.cli.task_types import given_options
        from contactgraph.cli.tasks import known_task, task_factory
        from contactgraph.control import read_cost, searches
        from contactgraph.data import Dataset, InvalidInputError
        from contactgraph.evaluate import ObservationNoise, control_task, evaluate_open_loop
        from contactgraph.viz import check_animation, scene_trajectory

        for path in (self.json, self.video, self.save):
            check_writable(path)
        if self.video is not None:
            check_animation(self.video)
        check_episodes(self.episodes)
        check_seed(self.seed)
        options = given_options(self)
        if self.model in _SCRIPTED:
            return self._write(self._by_policy(options), options)
        known = known_task(self.task)
        cost = None if self.cost is None else read_cost(self.cost)
        demands = cost is None or bool(cost.contacts)
        horizon = known.horizon * (1 if demands else _HORIZON_WITHOUT_CONTACTS)
        if self.horizon is not None:
            check_range("--horizon", self.horizon, 1, 1000)
            horizon = self.horizon
        check_range("--iterations", self.iterations, 1, 1000)
        if self.starts is not None:
            check_range("--starts", self.starts, 0, 10_000)
        routes = (0 if self.clearance is None else _ROUTES) if self.routes is None else self.routes
        check_range("--routes", routes, 0, 1000)
        check_range("--segment", self.segment, 0, horizon)
        if self.clearance is not None:
            check_range("--clearance", self.clearance, 0, 10)
        faults = sensor_faults(self.false_alarms, self.misses, self.delay, self.seed)
        if self.unmeasured and not faults.exact:
            raise InvalidInputError(
                "--unmeasured: no contact is measured, so --false-alarms, --misses and --delay "
                "must be left out"
            )
        noise = ObservationNoise(self.position_noise, self.velocity_noise, self.seed)
        factory = task_factory(self.task, options)
        model = with_inference(stored_model(self.model), self.inference)
        starts = self.starts
        if starts is None:
            starts = HIDDEN_HOLD_STARTS if self.hidden_switch else known.starts
            starts = starts if searches(model) and not routes + self.segment else 0
        asked, ignored = self.infer_contacts, self.ignore_motion
        by_motion = motion_evidence(model, asked, ignored, noise.position, noise.velocity)
        first: list[EpisodeRecord] = []
        finished = itertools.count(1)
        with progress("controlling", self.episodes) as bar:

            def on_episode(trajectory: "Trajectory", record: "EpisodeRecord") -> None:
                first[:] = first or [record]
                bar.advance(next(finished))

            metrics, trajectories = control_task(
                model,
                factory,
                self.episodes,
                self.seed,
                cost=cost,
                horizon=horizon,
                iterations=self.iterations,
                starts=starts,
                routes=routes,
                segment=self.segment,
                clearance=self.clearance,
                replan_every=self.replan_every,
                deadline=None if self.deadline_ms is None else self.deadline_ms / 1e3,
                faults=faults,
                measured=not self.unmeasured,
                noise=noise,
                motion_noise=by_motion,
                on_episode=on_episode,
            )
        predicted: Mapping[str, Any] = not_predicted()
        if any(each.steps >= round(_PREDICTED_S / each.scene.dt) for each in trajectories):
            predicted = evaluate_open_loop(
                model, Dataset(tuple(trajectories)), faults=faults, motion_noise=by_motion
            ).to_json()
        settings = {
            **{name: getattr(self, name) for name in _RECORDED},
            "cost": None if self.cost is None else str(self.cost),
            "horizon": horizon,
            "starts": starts,
            "routes": routes,
            "infer_contacts": by_motion is not None,
        }
        recorded = data_simulator(self.model)
        simulator = str(trajectories[0].scene.metadata.get("simulator", recorded))
        if recorded not in (None, simulator):
            print(f"{self.model} was trained on {recorded}; these episodes are on {simulator}")
        controlled = _Controlled(
            trajectories,
            metrics,
            settings,
            predicted,
            metrics.to_json(),
            lambda name: scene_trajectory(model, name, trajectories[0], first[0].plan),
        )
        return self._write(controlled, options)

    def _by_policy(self, options: Mapping[str, Any]) -> _Controlled:
        """By a scripted policy, which predicts, plans and estimates nothing."""
        from contactgraph.cli.control_output import not_planned, not_predicted
        from contactgraph.cli.output import progress
        from contactgraph.cli.tasks import known_task, task_factory
        from contactgraph.data import InvalidInputError
        from contactgraph.evaluate import control_by_policy
        from contactgraph.viz import recorded_scene

        defaults = {each.name: each.default for each in fields(self)}
        names = (*_RECORDED, "deadline_ms", "ignore_motion")
        given = [name for name in names if getattr(self, name) != defaults[name]]
        if given:
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in given)
            raise InvalidInputError(
                f"{flags}: for a model only; {self.model} is a scripted policy, which neither "
                "plans nor estimates"
            )
        known = known_task(self.task)
        fixed_start = self.model == "fixed-start" and known.fixed_start
        factory = task_factory(self.task, options)
        finished = itertools.count(1)
        with progress("controlling", self.episodes) as bar:
            metrics, trajectories = control_by_policy(
                (fixed_start or known.demonstrator)(),
                factory,
                self.episodes,
                self.seed,
                on_episode=lambda trajectory: bar.advance(next(finished)),
            )
        return _Controlled(
            trajectories,
            metrics,
            dict.fromkeys(_RECORDED),
            not_predicted(),
            {**metrics.to_json(), **not_planned()},
            lambda name: recorded_scene(name, trajectories[0]),
        )

    def _write(
        self, controlled: _Controlled, options: Mapping[str, Any]
    ) -> "Callable[[str], SceneTrajectory]":
        """The files that are asked for, and the summary."""
        from contactgraph.cli.control_output import print_summary
        from contactgraph.cli.output import write_json
        from contactgraph.cli.task_types import options_metadata
        from contactgraph.data import Metadata, write_trajectories
        from contactgraph.viz import write_animation

        metadata: Metadata = {"task": self.task, "seed": self.seed, **options_metadata(options)}
        if self.save is not None:
            write_trajectories(self.save, controlled.trajectories, metadata)
        if self.video is not None:
            name = f"{self.task}, {self.distractors} distractors"
            write_animation(self.video, controlled.scene(name))
        values = {**controlled.settings, **controlled.predicted, **controlled.measured}
        write_json(self.json, {"run": self.model, **metadata, **values})
        print_summary(controlled.metrics, controlled.predicted)
        return controlled.scene
